# Everything happens in a virtual environment of its own, .venv; `make demo` and `make test` need only Python 3.11+.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Processes that run the tests; a file's tests stay in one of them, so that its fixtures are made once.
JOBS ?= auto
# Where it is set, as in many containers, hundreds of processes compile all modules again, which takes each half a second.
unexport PYTHONDONTWRITEBYTECODE
PYTEST := $(BIN)/pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test lint docs clean

demo: $(VENV)/.demo  ## replay a fixture recording on its map and show the errors
	$(BIN)/hsloc replay recordings/office.mcap --unknown-start --out results/demo --overwrite
	@echo "Look at results/demo/report.png, or open results/demo/run.mcap in Lichtblick or Foxglove."

# The kernels run twice: compiled, where coverage cannot see into them, and as plain Python, where it can, beside the
# others. Each run has a data file of its own, as pytest-cov erases what is beside its own.
COVERAGE := build/coverage
test: $(VENV)/.dev build/numba/.compiled  ## all tests on all cores, and the coverage gate (pyproject: fail_under)
	rm -rf $(COVERAGE) && mkdir -p $(COVERAGE)/compiled $(COVERAGE)/plain
	NUMBA_DISABLE_JIT=1 COVERAGE_FILE=$(COVERAGE)/plain/data $(BIN)/pytest -q -p no:cacheprovider \
		--cov --cov-report= --cov-fail-under=0 tests/kernels >$(COVERAGE)/plain.txt 2>&1 & plain=$$!; \
	COVERAGE_FILE=$(COVERAGE)/compiled/data $(PYTEST) --cov --cov-report= --cov-fail-under=0; failed=$$?; \
	wait $$plain || failed=$$?; echo "-- the kernels as plain Python"; cat $(COVERAGE)/plain.txt; exit $$failed
	$(BIN)/coverage combine -q --data-file=$(COVERAGE)/data $(COVERAGE)/compiled/data $(COVERAGE)/plain/data
	$(BIN)/coverage report --data-file=$(COVERAGE)/data

# Each process that runs tests would compile all kernels, which takes it a minute: here two compile a half each. In half a
# minute of the office a loop is closed. Each service would begin the warm-up anew, until one has lived to its end.
# As modules, which run while pip puts hsloc's own entry in the environment anew.
AS_MODULE := export NUMBA_CACHE_DIR=$(CURDIR)/build/numba MPLCONFIGDIR=$(CURDIR)/build/matplotlib PYTHONPATH=service; \
	$(BIN)/python -m
build/numba/.compiled: hsloc/kernels/*.py requirements.lock | $(VENV)/.demo
	mkdir -p $(@D) && rm -rf build/compiled
	$(AS_MODULE) hsloc.cli.main replay recordings/office.mcap --end 15 --unknown-start --certify -q \
		--out build/compiled/replay & \
	$(AS_MODULE) hsloc.cli.main map recordings/office.mcap --end 30 --time-offset auto -q --out build/compiled/map \
		&& wait $$!
	$(AS_MODULE) hsloc_service.execution.warm_up >/dev/null
	touch $@

lint: $(VENV)/.dev  ## style, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/.docs  ## the documentation as a site in build/site; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build -q --strict

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit("hsloc needs Python 3.11 or newer; set PYTHON=python3.11") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(VENV)/bin/python pyproject.toml requirements.lock
	$(BIN)/python -m pip install -q --disable-pip-version-check -c requirements.lock -e .
	touch $@

$(VENV)/.dev: $(VENV)/.demo
	$(BIN)/python -m pip install -q --disable-pip-version-check -c requirements.lock -e '.[dev]'
	touch $@

# Both at once: pip builds and resolves once.
$(VENV)/.all: $(VENV)/.demo
	$(BIN)/python -m pip install -q --disable-pip-version-check -c requirements.lock -e '.[dev,docs]'
	touch $(VENV)/.dev $(VENV)/.docs $@

$(VENV)/.docs: $(VENV)/.demo
	$(BIN)/python -m pip install -q --disable-pip-version-check -c requirements.lock -e '.[docs]'
	touch $@

clean:  ## remove the virtual environment and what tools left behind
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage .coverage.*
	find hsloc service tests -name __pycache__ -type d -exec rm -rf {} +
