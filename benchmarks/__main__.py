"""Run all benchmarks, print Markdown tables and write them to benchmarks/results: ``python -m benchmarks``.

``python -m benchmarks sizes TREE...`` counts in the code what drifts, and runs nothing (`benchmarks.sizes`);
``python -m benchmarks starts`` counts from which starts the right answer is found (`benchmarks.starts`);
``python -m benchmarks modes`` counts how often a search over mode sequences finds the truth (`benchmarks.modes`);
``python -m benchmarks sharp`` fits models with corners, beside SciPy (`benchmarks.sharp`);
``python -m benchmarks harm`` compares the default with one local fit (`benchmarks.harm`);
``python -m benchmarks online`` drives sample by sample, beside other tools (`benchmarks.online`).
"""

from __future__ import annotations

import argparse
import sys
import time

from benchmarks import machine, sizes

PARTS = ("derivatives", "peers", "fit", "fits", "cold", "many", "scaling", "runs", "stiff", "threads")


def main() -> None:
    """Parse the command line and run the parts asked for."""
    if sys.argv[1:2] == ["sizes"]:
        sizes.main(sys.argv[2:])
        return
    if sys.argv[1:2] == ["starts"]:
        from benchmarks.starts import command

        command.main(sys.argv[2:])
        return
    if sys.argv[1:2] == ["modes"]:
        from benchmarks.modes import command as modes_command

        modes_command.main(sys.argv[2:])
        return
    if sys.argv[1:2] == ["sharp"]:
        from benchmarks.sharp import command as sharp_command

        sharp_command.main(sys.argv[2:])
        return
    if sys.argv[1:2] == ["harm"]:
        from benchmarks import harm

        harm.main(sys.argv[2:])
        return
    if sys.argv[1:2] == ["online"]:
        from benchmarks.online import command as online_command

        online_command.main(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer cases and repetitions; some minutes")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"only these of: {', '.join(PARTS)}")
    options = parser.parse_args()
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    cores = machine.use_one_core()  # before JAX starts its threads

    from benchmarks import cold, derivatives, fit, fits, many, runs, scaling, side_by_side, stiff, threads
    from benchmarks.report import Report

    report = Report(machine.describe(cores))
    run = {
        "derivatives": lambda: derivatives.run(report, options.quick),
        "peers": lambda: side_by_side.run(report, options.quick),
        "fit": lambda: fit.run(report, options.quick),
        "fits": lambda: fits.run(report, options.quick),
        "cold": lambda: cold.run(report, options.quick, cores),
        "many": lambda: many.run(report, options.quick, cores),
        "scaling": lambda: scaling.run(report, options.quick),
        "runs": lambda: runs.run(report, options.quick),
        "stiff": lambda: stiff.run(report, options.quick),
        "threads": lambda: threads.run(report, options.quick, cores),
    }
    began = time.perf_counter()
    for part in options.parts or PARTS:
        run[part]()
    report.note(f"Measured in {time.perf_counter() - began:.0f} s.")
    report.close("quick" if options.quick else "full")


if __name__ == "__main__":
    main()
