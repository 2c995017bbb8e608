# make demo: set everything up and detect the discs of the demo run.
# make test: set everything up and pass the tests.
# make docs: the documentation as a site, build/docs/index.html; what leads nowhere is an error.
# make package: build wheel and source distribution, install and use each in an empty environment.
# make lowest: pass the tests of what packages are used for, with the lowest versions that are allowed.
# make audit: look the locked packages up among known vulnerabilities; needs the internet.
# Only python3 (3.11 or newer), make and git are assumed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test check lint docs package lowest lowest-setup audit clean setup

# The environment is made anew whenever it is not complete, was moved, or pyproject.toml has changed.
setup:
	@$(PYTHON) tools/make_environment.py $(VENV)

demo: setup
	$(BIN)/detect circles images/e --force
	$(BIN)/detect compare images/e

# The files with the longest tests come first (tests/conftest.py), so that no worker is alone at the end.
test: setup
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

check: lint docs

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: setup
	$(BIN)/sphinx-build -q -j 2 --fail-on-warning docs build/docs

package: setup
	$(BIN)/python tools/try_package.py

# Of so old packages there are wheels for Python 3.11. Kernels of another Numba are kept apart; the first files compile
# different ones, so that none is compiled twice at the same time.
# What each package is needed for is tried: images and videos (OpenCV), kernels (Numba, llvmlite), whole runs of
# every detector (NumPy), poses (pycolmap), bags (rosbags), tables (pyarrow), YAML, command lines (tyro, rich),
# reports (Jinja, matplotlib), recordings (rerun), maps (SciPy, gtsam), drawings (ezdxf).
LOWEST := build/lowest
LOWEST_TESTS := tests/detect/test_circles_run.py tests/detect/test_lines_run.py \
    tests/detect/markers/test_markers_run.py tests/groundtruth/test_cli.py tests/slam/test_map_command.py \
    tests/slam/test_filter_commands.py tests/slam/test_g2o_gtsam.py tests/slam/test_pictures.py \
    tests/groundtruth/lasers/test_building.py tests/detect/test_sources_bag.py tests/detect/test_sources.py \
    tests/detect/test_exports.py tests/detect/test_report.py tests/detect/test_viewing_sources.py \
    tests/camera/test_convert.py tests/lut tests/fuzz
lowest-setup: $(LOWEST)/ready

$(LOWEST)/ready: requirements/lowest-lock.txt
	python3.11 -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install -q --no-compile --require-hashes --no-deps -r requirements/lowest-lock.txt
	touch $@

lowest: lowest-setup
	NUMBA_CACHE_DIR=$(LOWEST)/kernels REDETECT_CACHE=$(LOWEST)/tables $(LOWEST)/bin/python -m pytest \
	    -n auto --dist loadfile --no-loadscope-reorder -q -p no:cacheprovider -m "not long" \
	    --deselect tests/slam/test_g2o_gtsam.py::test_the_demo_run $(LOWEST_TESTS)

audit: setup
	$(BIN)/pip install -q pip-audit
	$(BIN)/pip-audit -r requirements/lock.txt --require-hashes --disable-pip

clean:
	rm -rf $(VENV) build dist docs/api *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
