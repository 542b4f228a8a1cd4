# make demo          set up, localize the photos of examples/flat, print the errors against the true poses, write a report
# make test          set up, run the tests that start no processes, but those of research/
# make test-all      set up, run every test but those of the report's page
# make test-kernels  set up, run the numerical tests without compiling, so that array bounds are checked
# make test-browser  set up, run the tests of the report's page in Chromium (apt-get install chromium npm)
# make test-wide     set up, try what photos and scans say wrongly of themselves; not in CI, some twenty minutes
# make check         set up, lint, format and types
# make check-page    the same of the report's page, and that its bundle is made from its sources (Node 20)
# make test-lowest   set up, run tests that use each library, with the lowest versions that requirements.txt and pyproject.toml allow
# make lock          write requirements.lock from requirements.txt and pyproject.toml; with UPGRADE=--upgrade, of the newest versions
# make release       check that versions agree, make and try the files of a release in dist/; nothing is sent
# make clean         remove what these made

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test test-all test-kernels test-browser test-lowest test-wide check check-page lock release clean

$(VENV)/ready: requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "found $$($(PYTHON) --version), wanted Python 3.11 or newer: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "no virtual environment could be made; on Debian: apt-get install python3-venv" >&2; rm -rf $(VENV); exit 1; }
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -r requirements.lock
	@touch $@

demo: $(VENV)/ready
	@mkdir -p demo
	$(BIN)/python localize.py --cloud examples/flat/cloud.ply --pano examples/flat/images/living_room.jpg --out demo/pose.json --overwrite --overlay demo/overlay.png
	$(BIN)/python localize.py --cloud examples/flat/cloud.ply --pano examples/flat/images --out demo/poses.jsonl --overwrite --quiet
	$(BIN)/python tools/evaluate.py --scenes examples/flat --results demo/poses.jsonl
	$(BIN)/python tools/report.py --results demo/poses.jsonl --cloud examples/flat/cloud.ply --out demo/report --plan demo/plan.png --title "Sample flat"
	@echo "Done: open demo/report/index.html in a browser; demo/overlay.png compares one photo with the scan."

# or each worker, and each process that tests start, compiles all sources anew
unexport PYTHONDONTWRITEBYTECODE

# each core has a process: further threads of libraries only wait for a core, and take a tenth more time
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: $(VENV)/ready
	$(PYTEST) -m "not process and not research"

test-all: $(VENV)/ready
	$(PYTEST)

# of the tests of kernels, those that need seconds in plain Python
KERNELS := channel_loss cone cloud_morton cloud_octree cloud_profiles local_features_sift p3p pose sampling_loss sphere zbuffer

test-kernels: $(VENV)/ready
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(KERNELS:%=tests/test_%.py)

# tests that call each library, and Numba's insides; and golden poses
LOWEST := cache camera_files cloud_e57 cloud_las cloud_mesh cloud_pcd cloud_ply cloud_units cluster doors export export_models export_rerun export_tables localize panorama_formats pose p3p report_plan_file result service sphere threads memory view video

$(VENV)-lowest/ready: requirements.txt pyproject.toml | $(VENV)/ready
	$(BIN)/uv venv --quiet --clear --python $(PYTHON) $(VENV)-lowest
	$(BIN)/uv pip install --quiet --python $(VENV)-lowest/bin/python --resolution lowest-direct --group dev --all-extras -r pyproject.toml
	@touch $@

test-lowest: $(VENV)-lowest/ready
	$(ONE_THREAD) $(VENV)-lowest/bin/python -m pytest $(LOWEST:%=tests/test_%.py) tests/test_localization.py::test_golden_poses tests/test_paper_method.py::test_golden_poses

# wheels for each Python that pyproject.toml names
lock: $(VENV)/ready
	$(BIN)/uv pip compile --quiet pyproject.toml --all-extras --group dev --universal --python-version 3.11 --no-annotate --custom-compile-command "make lock" $(UPGRADE) --output-file requirements.lock
	for version in 3.11 3.12 3.13 3.14; do $(BIN)/uv pip compile --quiet requirements.lock --no-deps --only-binary :all: --python-version $$version --output-file /dev/null || exit 1; done

release: $(VENV)/ready
	.ci/release $(BIN)

test-wide: $(VENV)/ready
	@mkdir -p demo
	$(BIN)/python tools/benchmark.py confidence --claims --seeds 0 3 --scenes examples/flat --out demo/wide.jsonl

test-browser: $(VENV)/ready page/node_modules/ready
	$(BIN)/python -m pytest browser_tests

page/node_modules/ready: page/package-lock.json
	@command -v npm > /dev/null || { echo "found no npm; on Debian: apt-get install npm" >&2; exit 1; }
	cd page && npm ci --ignore-scripts --no-fund --no-audit
	@touch $@

check-page: page/node_modules/ready
	cd page && npm run check

check: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) $(VENV)-lowest demo build dist *.egg-info page/node_modules browser_tests/screenshots .mypy_cache .ruff_cache .pytest_cache .hypothesis
