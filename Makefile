# make demo: set everything up and detect the discs of the demo run.
# make test: set everything up and pass the tests.
# Only python3 (3.11 or newer), make and git are assumed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test check clean setup

# The environment is made anew whenever it is not complete, was moved, or pyproject.toml has changed.
setup:
	@$(PYTHON) tools/make_environment.py $(VENV)

demo: setup
	$(BIN)/detect circles images/e --force
	$(BIN)/detect compare images/e

test: setup
	$(BIN)/python -m pytest -n auto --dist loadfile

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
