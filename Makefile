# make demo: set everything up, detect what is in the demo run, compare it with the truth, make a page.
# make test: set everything up, compile the kernels, pass the tests.
# make docs: the documentation as a site, build/docs/index.html; what leads nowhere is an error.
# make figures: measure everything that documents quote, and put it into them (tools/evaluation/figures.mk); half an hour.
# make package: build wheel and source distribution, install and use each in an empty environment.
# make lowest: pass the tests of what packages are used for, with the lowest versions that are allowed.
# make lowest-more: pass more of them with these versions; takes long.
# make audit: look the locked packages up among known vulnerabilities; needs the internet.
# Only python3 (3.11 or newer), make and git are assumed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What Python has compiled once is kept, whatever the environment says: tests start many processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo kernels test check lint docs figures package lowest lowest-more lowest-setup audit clean setup

# The environment is made anew whenever it is not complete, was moved, or pyproject.toml has changed.
setup:
	@$(PYTHON) tools/make_environment.py $(VENV)

demo: setup
	$(BIN)/redetect demo --run images/e -o build/demo --force

# Kernels are compiled beforehand, by two processes: workers of tests that need the same one at once would each compile it.
define compile_kernels
mkdir -p $(2)
$(1) circles images/e --jobs 1 -o $(2)/compiled.circles --json $(2)/compiled.json --force & discs=$$!; \
    $(1) lines images/e --jobs 1 -o $(2)/compiled.lines --force && \
    $(1) markers images/m/a -o $(2)/m.markers --force; others=$$?; wait $$discs && exit $$others
endef

# A kernel that others call exists several times, optimised among different code, and which of them runs depends on what
# was compiled in the same process: so what kernels find that were just compiled is compared with what they find when
# they are loaded.
kernels: setup
	$(call compile_kernels,$(BIN)/detect,build/kernels)
	$(BIN)/detect circles images/e --jobs 1 -o build/kernels/loaded.circles --json build/kernels/loaded.json --force & discs=$$!; \
	    $(BIN)/detect lines images/e --jobs 1 -o build/kernels/loaded.lines --force && \
	    $(BIN)/detect all images/e --output build/kernels --force; others=$$?; wait $$discs && exit $$others
	cmp build/kernels/compiled.json build/kernels/loaded.json
	cmp build/kernels/compiled.lines build/kernels/loaded.lines

test: kernels
	$(BIN)/python -m pytest -n auto --dist worksteal

check: lint docs

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: setup
	$(BIN)/sphinx-build -q -j 2 --fail-on-warning docs build/docs

# A figure is made again where code is newer than it is; no figure depends on documents.
figures: setup
	$(MAKE) -f tools/evaluation/figures.mk BIN=$(BIN)

package: setup
	$(BIN)/python tools/try_package.py

# Of so old packages there are wheels for Python 3.11. Kernels of another Numba are kept apart, and by a whole path:
# tests start programs in other folders. Tests marked `lowest` try what each package is needed for: images (OpenCV),
# kernels (Numba, llvmlite) and whole runs of every detector (NumPy); poses (pycolmap), maps (SciPy, gtsam), drawings
# (ezdxf), YAML, tables (pyarrow), command lines (tyro, rich), scikit-image; then reports (Jinja, matplotlib),
# recordings (rerun), videos, bags (rosbags), a cluster.
LOWEST := $(CURDIR)/build/lowest
# More of the same, and all readers: before a release.
LOWEST_MORE := tests/detect/runs/test_circles_run.py tests/detect/markers/test_markers_run.py tests/detect/runs/test_lines_run.py \
    tests/groundtruth/test_cli.py tests/slam/test_map_command.py tests/slam/test_filter_commands.py \
    tests/slam/test_g2o_gtsam.py tests/slam/test_pictures.py tests/groundtruth/lasers/test_building.py \
    tests/detect/sources/test_bag.py tests/detect/sources/test_sources.py tests/detect/exports/test_exports.py tests/detect/report/test_report.py \
    tests/detect/test_viewing_sources.py tests/camera/test_convert.py tests/lut tests/fuzz
LOWEST_CACHES := NUMBA_CACHE_DIR=$(LOWEST)/kernels REDETECT_CACHE=$(LOWEST)/tables
LOWEST_PYTEST := $(LOWEST_CACHES) $(LOWEST)/bin/python -m pytest -n auto --dist worksteal -q -p no:cacheprovider
lowest-setup: $(LOWEST)/ready

$(LOWEST)/ready: requirements/lowest-lock.txt
	python3.11 -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install -q --disable-pip-version-check --no-compile --require-hashes --no-deps \
	    -r requirements/lowest-lock.txt
	touch $@

lowest: lowest-setup
	$(call compile_kernels,$(LOWEST_CACHES) $(LOWEST)/bin/python -m detect,$(LOWEST)/found)
	$(LOWEST_PYTEST) -m lowest $$(grep -rl --include='test_*.py' 'mark\.lowest' tests)

lowest-more: lowest-setup
	$(LOWEST_PYTEST) -m "not long" --deselect tests/slam/test_g2o_gtsam.py::test_the_demo_run $(LOWEST_MORE)

audit: setup
	$(BIN)/pip install -q pip-audit
	$(BIN)/pip-audit -r requirements/lock.txt --require-hashes --disable-pip

clean:
	rm -rf $(VENV) build dist docs/api *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
