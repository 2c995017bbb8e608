# make demo: set everything up and detect the discs of the demo run.
# make test: set everything up and pass the tests.
# make docs: the documentation as a site, build/docs/index.html; what leads nowhere is an error.
# make package: build wheel and source distribution, install and use each in an empty environment.
# Only python3 (3.11 or newer), make and git are assumed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test check docs package clean setup

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

clean:
	rm -rf $(VENV) build dist docs/api *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
