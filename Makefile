# make demo: set everything up and detect the discs of the demo run.
# make test: set everything up and pass the tests.
# make docs: the documentation as a site, build/docs/index.html; what leads nowhere is an error.
# make package: build wheel and source distribution, install and use each in an empty environment.
# make lowest: pass some of the tests with the lowest versions of packages that are allowed.
# make audit: look the locked packages up among known vulnerabilities; needs the internet.
# Only python3 (3.11 or newer), make and git are assumed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test check docs package lowest audit clean setup

# The environment is made anew whenever it is not complete, was moved, or pyproject.toml has changed.
setup:
	@$(PYTHON) tools/make_environment.py $(VENV)

demo: setup
	$(BIN)/detect circles images/e --force
	$(BIN)/detect compare images/e

test: setup
	$(BIN)/python -m pytest -n auto --dist loadfile

check: setup docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: setup
	$(BIN)/sphinx-build -q -j 2 --fail-on-warning docs build/docs

package: setup
	$(BIN)/python tools/try_package.py

# Of so old packages there are wheels for Python 3.11. Kernels of another Numba are kept apart.
LOWEST := build/lowest
LOWEST_TESTS := tests/storage tests/landmarks tests/lut tests/camera/test_camfile.py \
    tests/camera/test_convert.py tests/detect/test_sources.py tests/fuzz
lowest:
	python3.11 -m venv $(LOWEST)
	$(LOWEST)/bin/pip install -q -r requirements/lowest.txt
	$(LOWEST)/bin/pip install -q --no-deps -e .
	NUMBA_CACHE_DIR=$(LOWEST)/kernels REDETECT_CACHE=$(LOWEST)/tables $(LOWEST)/bin/python -m pytest \
	    -n auto --dist loadfile -q -p no:cacheprovider -m "not long" $(LOWEST_TESTS)

audit: setup
	$(BIN)/pip install -q pip-audit
	$(BIN)/pip-audit -r requirements/lock.txt --require-hashes --disable-pip

clean:
	rm -rf $(VENV) build dist docs/api *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
