# make demo          set up, localize the photos of examples/flat, print the errors against the true poses, write a report
# make test          set up, run the tests that start no processes, but those of research/
# make test-all      set up, run every test but those of the report's page
# make test-kernels  set up, run the numerical tests once without compiling and once with array bounds checked
# make test-browser  set up, run the tests of the report's page in Chromium (apt-get install chromium npm)
# make test-wide     set up, try what photos and scans say wrongly of themselves; not in CI, some twenty minutes
# make check         set up, lint, format and types
# make check-page    the same of the report's page, and that its bundle is made from its sources (Node 20)
# make clean         remove what these made

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test test-all test-kernels kernels-plain kernels-checked test-browser test-wide check check-page clean

$(VENV)/ready: requirements.lock requirements-formats.lock requirements-gps.lock requirements-plans.lock requirements-colmap.lock requirements-serve.lock requirements-rerun.lock requirements-cluster.lock requirements-video.lock requirements-dev.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "found $$($(PYTHON) --version), wanted Python 3.11 or newer: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "no virtual environment could be made; on Debian: apt-get install python3-venv" >&2; rm -rf $(VENV); exit 1; }
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -r requirements.lock -r requirements-formats.lock -r requirements-gps.lock -r requirements-plans.lock -r requirements-colmap.lock -r requirements-serve.lock -r requirements-rerun.lock -r requirements-cluster.lock -r requirements-video.lock -r requirements-dev.lock
	@touch $@

demo: $(VENV)/ready
	@mkdir -p demo
	$(BIN)/python localize.py --cloud examples/flat/cloud.ply --pano examples/flat/images/living_room.jpg --out demo/pose.json --overwrite --overlay demo/overlay.png
	$(BIN)/python localize.py --cloud examples/flat/cloud.ply --pano examples/flat/images --out demo/poses.jsonl --overwrite --quiet
	$(BIN)/python tools/evaluate.py --scenes examples/flat --results demo/poses.jsonl
	$(BIN)/python tools/report.py --results demo/poses.jsonl --cloud examples/flat/cloud.ply --out demo/report --plan demo/plan.png --title "Sample flat"
	@echo "Done: open demo/report/index.html in a browser; demo/overlay.png compares one photo with the scan."

# each core has a process: further threads of libraries only wait for a core, and take a tenth more time
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: $(VENV)/ready
	$(PYTEST) -m "not process and not research"

test-all: $(VENV)/ready
	$(PYTEST)

# of the tests of kernels, those that need seconds in plain Python
KERNELS := channel_loss cone cloud_morton cloud_octree cloud_profiles p3p pose sampling_loss sphere zbuffer

test-kernels: kernels-plain kernels-checked

kernels-plain: $(VENV)/ready
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(KERNELS:%=tests/test_%.py)

kernels-checked: $(VENV)/ready
	NUMBA_BOUNDSCHECK=1 $(BIN)/python -m pytest $(KERNELS:%=tests/test_%.py)

test-wide: $(VENV)/ready
	@mkdir -p demo
	$(BIN)/python tools/benchmark.py confidence --claims --seeds 0 3 --scenes examples/flat --out demo/wide.jsonl

test-browser: $(VENV)/browser page/node_modules/ready
	$(BIN)/python -m pytest browser_tests

$(VENV)/browser: $(VENV)/ready requirements-browser.lock
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -r requirements-browser.lock
	@touch $@

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
	rm -rf $(VENV) demo page/node_modules browser_tests/screenshots .mypy_cache .ruff_cache .pytest_cache .hypothesis
