# make demo    set up, make a room, localize a panorama in it, print the error against the truth
# make test    set up, run every test
# make check   set up, lint, format and types
# make clean   remove what these made

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test check clean

$(VENV)/ready: requirements.lock requirements-formats.lock requirements-tools.lock requirements-distributed.lock requirements-video.lock requirements-dev.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "found $$($(PYTHON) --version), wanted Python 3.11 or newer: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "no virtual environment could be made; on Debian: apt-get install python3-venv" >&2; rm -rf $(VENV); exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock -r requirements-formats.lock -r requirements-tools.lock -r requirements-distributed.lock -r requirements-video.lock -r requirements-dev.lock
	@touch $@

demo: $(VENV)/ready
	$(BIN)/python tools/make_room.py --out demo --seed 7 --points 200000 --panoramas 1 > /dev/null
	$(BIN)/python localize.py --cloud demo/cloud.ply --pano demo/images/clean_0.jpg --out demo/pose.json --overwrite --overlay demo/overlay.png
	$(BIN)/python tools/evaluate.py --scenes demo --results demo/pose.json

test: $(VENV)/ready
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) demo .mypy_cache .ruff_cache .pytest_cache .hypothesis
