"""The layout of XLA's frames that machine code reads, against the header of the JAX that is installed."""

import re
from pathlib import Path

import jax
import pytest

from switchfit.engine.native import program

HEADER = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()


def fields_of(name):
    """Names of the fields of a struct, in order."""
    body = re.search(rf"struct XLA_FFI_{name} \{{(.*?)\n\}}[^;]*;", HEADER, re.S)[1]
    code = re.sub(r"//[^\n]*|/\*.*?\*/", "", body, flags=re.S)
    return [declaration.split()[-1] for declaration in code.split(";") if declaration.strip()]


@pytest.mark.parametrize(
    ("name", "fields"),
    [  # up to the last one that is read; each takes eight bytes, but `args` in a frame, a struct of five such
        ("CallFrame", "struct_size extension_start api ctx stage args rets"),
        ("Args", "struct_size extension_start size types args"),
        ("Rets", "struct_size extension_start size types rets"),
        ("Buffer", "struct_size extension_start dtype data rank dims"),
        ("Extension_Base", "struct_size type next"),
        ("Metadata_Extension", "extension_base metadata"),
        ("Metadata", "struct_size api_version traits"),
        ("Api_Version", "struct_size extension_start major_version minor_version"),
    ],
)
def test_structs_have_the_fields_of_which_the_offsets_are_known(name, fields):
    assert fields_of(name)[: len(fields.split())] == fields.split()


def test_the_offsets_and_the_version_are_those_of_the_header():
    args, rets = (8 * fields_of(name).index(name.lower()) for name in ("Args", "Rets"))
    assert 8 * fields_of("CallFrame").index("extension_start") == program.EXTENSION
    assert (5 * 8 + args, 5 * 8 + 5 * 8 + rets) == (program.ARGUMENTS, program.RESULTS)
    assert [8 * fields_of("Buffer").index(name) for name in ("data", "dims")] == [program.DATA, program.DIMENSIONS]
    major, minor = (int(re.search(rf"#define XLA_FFI_API_{name} (\d+)", HEADER)[1]) for name in ("MAJOR", "MINOR"))
    assert major == program.MAJOR
    assert minor >= program.MINOR
