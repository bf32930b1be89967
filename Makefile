# Every target sets up what it needs in .venv; nothing has to be done before.
#   make demo         grow, hurt and heal the shipped rule, train a small one (CPU); writes demo/
#   make test         the test suite without the slow tests
#   make test-all     all tests
#   make test-cuda    the tests of kernels, worlds and training on a GPU, kernels compiled once
#   make check        ruff, formatting, types, spelling
#   make docs         the documentation's site, in build/docs/; warnings are errors
#   make bench-check  is the library still as much faster than its alternatives as it was?
#   make golden-check is what it computes bit for bit what it was at the commit in tests/golden/commit?
#   make faults       do the tests find the faults of tests/faults/faults.toml?
# PIP_ARGS goes to pip: PIP_ARGS='--extra-index-url https://download.pytorch.org/whl/cpu' takes
# torch's smaller CPU build.

PYTHON ?= python3
PIP_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
CHECK := build/check

# A stamp a set of extras, older than these files: pip runs again only when they change.
CORE := $(VENV)/installed-core
DEV := $(VENV)/installed-dev
DOCS := $(VENV)/installed-docs
INPUTS := pyproject.toml constraints.txt

# Each worker takes whole folders, whose libraries and kernels the other one need not load.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal
CUDA_WORKERS ?= 8

.PHONY: demo test test-all test-cuda check docs bench-check golden-check faults clean
.DELETE_ON_ERROR:
# Tests start processes, each of which would compile the library's modules again.
unexport PYTHONDONTWRITEBYTECODE

$(BIN)/python:
	$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit("npa-envs needs Python 3.11 or newer, got %d.%d: make PYTHON=python3.12" % v[:2])'
	$(PYTHON) -m venv $(VENV)

$(CORE): $(INPUTS) | $(BIN)/python
	@echo "installing torch and more: two minutes, with CUDA up to twenty"
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) -e . -c constraints.txt
	touch $@

$(DEV): $(INPUTS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) -e '.[dev]' -c constraints.txt
	touch $@ $(CORE)

# What is installed already stays as it is: only the packages that these extras name are added.
$(DOCS): $(INPUTS) $(wildcard $(CORE)) | $(BIN)/python
	$(BIN)/python -m pip show --quiet npa-envs 2>/dev/null || $(MAKE) $(CORE)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) 'npa-envs[dev,docs]' -c constraints.txt
	touch $@

demo: $(CORE)
	$(BIN)/npa-envs warmup --device cpu
	$(BIN)/npa-envs demo --device cpu --out demo
	@echo "next: open demo/gecko.mp4; then: source .venv/bin/activate, pip install -e '.[view]', npa-envs view gecko"

test: $(DEV)
	$(PYTEST) -m 'not slow'

test-all: $(DEV)
	$(PYTEST)

test-cuda: $(DEV)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(CUDA_WORKERS) --device cuda -m '(device or gpu) and not slow'

# Static checkers do not follow the editable finder for envs/, wrappers/ and agents/, so the types
# are checked in a regular install, made from a copy: setuptools would leave stale files in build/.
check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/typos
	rm -rf $(CHECK)
	mkdir -p $(CHECK)/source
	cp -R pyproject.toml README.md LICENSE npa_envs envs wrappers agents $(CHECK)/source
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --target $(CHECK)/site $(CHECK)/source
	cd $(CHECK)/site && ../../../$(BIN)/mypy --config-file ../../../pyproject.toml --cache-dir ../cache -p npa_envs

# The source folder is the root, so that links lead where they lead on a code host. As a module,
# Sphinx imports the library from there too, also where another one is installed.
docs: $(DOCS)
	$(BIN)/python -m sphinx -W --keep-going --quiet -b html -c docs -d build/docs-cache . build/docs
	@echo "the site: build/docs/index.html"

bench-check: $(CORE)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/alternatives.py --quick --device cpu --check benchmarks/results/ratios.json

golden-check: $(DEV)
	$(BIN)/python tests/golden/check.py

faults: $(DEV)
	$(BIN)/python tests/faults/run.py

clean:
	rm -rf build dist demo *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
