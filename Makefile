# make demo: set everything up and detect the discs of the demo run.
# make test: set everything up and pass the tests.
# make docs: the documentation as a site, build/docs/index.html; what leads nowhere is an error.
# make package: build wheel and source distribution, install and use each in an empty environment.
# make lowest: pass the tests of what packages are used for, with the lowest versions that are allowed.
# make lowest-more: pass more of them with these versions; takes long.
# make audit: look the locked packages up among known vulnerabilities; needs the internet.
# Only python3 (3.11 or newer), make and git are assumed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo kernels test check lint docs package lowest lowest-more lowest-setup audit clean setup

# The environment is made anew whenever it is not complete, was moved, or pyproject.toml has changed.
setup:
	@$(PYTHON) tools/make_environment.py $(VENV)

demo: setup
	$(BIN)/detect circles images/e --force
	$(BIN)/detect compare images/e

# Kernels are compiled beforehand: processes of tests that need the same one at once would each compile it.
kernels: setup
	$(BIN)/detect all images/e --output build/kernels --force
	$(BIN)/detect markers images/m/a --output build/kernels/m.markers --force

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

# Of so old packages there are wheels for Python 3.11. Kernels of another Numba are kept apart, and by a whole path:
# tests start programs in other folders. The first file compiles the detectors' kernels, which takes a minute or two;
# those after it need others, so that none is compiled twice at the same time.
# What each package is needed for is tried: images (OpenCV), kernels (Numba, llvmlite) and whole runs of every
# detector (NumPy); poses (pycolmap), maps (SciPy, gtsam), drawings (ezdxf), YAML, tables (pyarrow), command lines
# (tyro, rich), scikit-image; then reports (Jinja, matplotlib), recordings (rerun), videos, bags (rosbags), a cluster.
LOWEST := $(CURDIR)/build/lowest
LOWEST_TESTS := tests/detect/runs/test_circles_run.py tests/detect/markers/test_markers_run.py \
    tests/detect/runs/test_lines_run.py tests/groundtruth/test_cli.py::test_a_sessions_poses_and_their_score \
    'tests/groundtruth/markers/test_refinement.py::test_every_solver_recovers_the_pose_exactly[1-1-pycolmap]' \
    'tests/groundtruth/markers/test_refinement.py::test_every_solver_recovers_the_pose_exactly[6-2-pycolmap]' \
    tests/slam/test_map_command.py tests/slam/test_filter_commands.py::test_map_then_localise \
    tests/slam/test_g2o_gtsam.py::test_the_documented_way_from_the_tables_to_factors \
    tests/groundtruth/lasers/test_building.py tests/camera/test_convert.py::test_formats_read_back_what_they_wrote \
    tests/camera/test_convert.py::test_models_are_opencvs_and_invert \
    tests/camera/test_convert.py::test_opencv_reads_what_is_written_and_the_other_way \
    tests/camera/test_convert.py::test_colmap_counts_from_the_corner \
    tests/camera/test_convert.py::test_an_echoed_ros_message_is_read \
    tests/detect/exports/test_exports.py::test_parquet_has_the_files_numbers_and_units \
    tests/detect/exports/test_exports.py::test_mcap_has_the_files_numbers tests/test_command_lines.py \
    tests/tools/benchmark/test_peers.py tests/detect/report/test_report.py::test_page_states_what_comparing_does \
    tests/detect/test_view.py tests/detect/sources/test_sources.py::test_a_video_gives_the_rows_of_its_images \
    'tests/detect/sources/test_bag.py::test_a_bag_gives_the_rows_of_its_images[mcap-False]' \
    'tests/detect/sources/test_bag.py::test_a_bag_gives_the_rows_of_its_images[sqlite-False]' \
    'tests/detect/sources/test_bag.py::test_a_bag_gives_the_rows_of_its_images[ros1-True]' \
    tests/detect/runs/test_workers.py::test_a_cluster_writes_what_one_process_does
# More of the same, and all readers: before a release.
LOWEST_MORE := tests/detect/runs/test_circles_run.py tests/detect/markers/test_markers_run.py tests/detect/runs/test_lines_run.py \
    tests/groundtruth/test_cli.py tests/slam/test_map_command.py tests/slam/test_filter_commands.py \
    tests/slam/test_g2o_gtsam.py tests/slam/test_pictures.py tests/groundtruth/lasers/test_building.py \
    tests/detect/sources/test_bag.py tests/detect/sources/test_sources.py tests/detect/exports/test_exports.py tests/detect/report/test_report.py \
    tests/detect/test_viewing_sources.py tests/camera/test_convert.py tests/lut tests/fuzz
LOWEST_PYTEST := NUMBA_CACHE_DIR=$(LOWEST)/kernels REDETECT_CACHE=$(LOWEST)/tables $(LOWEST)/bin/python -m pytest \
    -n auto --dist loadfile --no-loadscope-reorder -q -p no:cacheprovider
lowest-setup: $(LOWEST)/ready

$(LOWEST)/ready: requirements/lowest-lock.txt
	python3.11 -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install -q --disable-pip-version-check --no-compile --require-hashes --no-deps \
	    -r requirements/lowest-lock.txt
	touch $@

lowest: lowest-setup
	$(LOWEST_PYTEST) $(LOWEST_TESTS)

lowest-more: lowest-setup
	$(LOWEST_PYTEST) -m "not long" --deselect tests/slam/test_g2o_gtsam.py::test_the_demo_run $(LOWEST_MORE)

audit: setup
	$(BIN)/pip install -q pip-audit
	$(BIN)/pip-audit -r requirements/lock.txt --require-hashes --disable-pip

clean:
	rm -rf $(VENV) build dist docs/api *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
