# A machine with Python 3.11 or newer and make is enough: the first target installs everything into .venv.
PYTHON ?= python3
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: help demo test test-slow fuzz coverage check format bench starts modes harm sharp online speed paper docs release-check clean

help:
	@echo "make demo       fit a measured toss and the paper's simulated vehicle: reports, figures in out/"
	@echo "make test       the tests;  make test-slow: statistics and long runs too;  make fuzz: seeded random tests"
	@echo "make coverage   how often intervals contain the truth, and how often online estimation is wrong (minutes)"
	@echo "make check      ruff and mypy;  make format: put the code into form"
	@echo "make bench      measure speed;  make speed: and put the figures into the documentation"
	@echo "make starts     from which starts the right answer is found, for many problems and methods (an hour; goes on)"
	@echo "make modes      how often the true mode sequence is found, beside other tools, into the documentation (minutes)"
	@echo "make sharp      how often models with corners are fitted, beside SciPy, into the documentation (half an hour)"
	@echo "make online     how late and how often wrong online estimation is, beside other tools, into the documentation (25 minutes)"
	@echo "make harm       whether the default is ever worse than a local fit, into the documentation (10 minutes)"
	@echo "make paper      every experiment and figure of the paper, into out/paper and the documentation (ten minutes)"
	@echo "make docs       build the documentation, into out/docs"
	@echo "make release-check  build wheel and sdist, install them into new environments and fit there (minutes)"
	@echo "make clean      remove what was built"

demo: $(VENV)/.installed-report
	$(BIN)/switchfit fit examples/toss/problem.toml --out out/demo
	$(BIN)/switchfit fit examples/vehicle/problem.toml --out out/demo-vehicle

# One process has all of a file: its tests share programs.
test: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadfile

test-slow: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) -m "slow or fuzz or not slow"

fuzz: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) -m fuzz

coverage: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/uncertainty/test_covariances.py tests/online/test_online_statistics.py -m slow -k "not unstable" -v -s

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.installed-bench
	$(BIN)/python -m benchmarks

starts: $(VENV)/.installed-bench
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks starts --methods exact,local,auto --processes $(JOBS)
	cp $$(ls -t benchmarks/results/starts-*.md | head -1) docs/measured/starts.md

modes: $(VENV)/.installed-bench
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks modes --peers --processes $(JOBS)
	cp benchmarks/results/modes.md docs/measured/modes.md

harm: $(VENV)/.installed-bench
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks harm
	cp benchmarks/results/harm.md docs/measured/harm.md

sharp: $(VENV)/.installed-bench
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks sharp
	cp benchmarks/results/sharp.md docs/measured/sharp.md

online: $(VENV)/.installed-bench
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks online
	cp benchmarks/results/online.md docs/measured/online.md

speed: bench
	cp benchmarks/results/full.md docs/measured/speed.md
	cp benchmarks/results/full.json docs/measured/speed.json

paper: $(VENV)/.installed
	$(BIN)/switchfit paper --out out/paper
	cp out/paper/table.md docs/measured/paper.md
	cp out/paper/results.json docs/measured/paper.json

release-check: $(VENV)/.installed-dev
	$(BIN)/python -m pytest tests/house/test_release.py -m "slow or not slow" -s

docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build -W --keep-going -q docs out/docs
	@echo "out/docs/index.html"

clean:
	rm -rf out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "switchfit needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

# Stamps: each set of packages is installed once, and again when pyproject.toml changes.
$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(PIP) install -e .
	@touch $@

$(VENV)/.installed-%: pyproject.toml | $(BIN)/python
	$(PIP) install -e '.[$*]'
	@touch $@ $(VENV)/.installed
