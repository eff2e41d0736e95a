# `make demo` and `make test` are all that a fresh machine needs: each builds the environment first.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
EXTRAS := synthetic,train,data,ros,metrics,viz,hub,onnx,test

MINUTES ?= 10
SEED   ?= 0

.PHONY: install demo test quick lint check format fuzz bench wheel docs clean

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[$(EXTRAS)]'
	touch $@

install: $(STAMP)

demo: $(STAMP)
	$(BIN)/lidarsynth demo --out demo

test: $(STAMP)
	$(BIN)/python -m pytest -n logical --dist loadfile

quick: $(STAMP)
	$(BIN)/python -m pytest -n logical --dist loadfile -m "not slow"

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

check: lint test

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

fuzz: $(STAMP)
	$(BIN)/python tests/fuzz.py --minutes $(MINUTES) --seed $(SEED)

bench: $(STAMP)
	for script in benchmarks/*.py; do $(BIN)/python $$script || exit 1; done

# The package as others get it, tried on every Python from 3.10 to 3.13 that is at hand.
wheel: $(STAMP)
	rm -rf dist
	$(BIN)/pip install --quiet --disable-pip-version-check build
	$(BIN)/python -m build --outdir dist .
	for v in 3.10 3.11 3.12 3.13; do \
	  command -v python$$v > /dev/null || { echo "python$$v is not at hand: not tried"; continue; }; \
	  python$$v -m venv dist/venv$$v && \
	  dist/venv$$v/bin/pip install --quiet --disable-pip-version-check --constraint constraints.txt torch && \
	  dist/venv$$v/bin/pip install --quiet --disable-pip-version-check "$$(ls dist/*.whl)[synthetic]" && \
	  (cd dist && venv$$v/bin/python -c "import lidarsynth" && venv$$v/bin/lidarsynth --help > /dev/null && \
	   venv$$v/bin/lidarsynth generate -n 1 --steps 2 --no-picture --out tried$$v) || exit 1; \
	  rm -rf dist/venv$$v; \
	done

# The documentation as a site, in site/; warnings are errors.
docs: $(STAMP)
	$(BIN)/pip install --quiet --disable-pip-version-check 'mkdocs-material>=9.5' 'mkdocstrings[python]>=0.26'
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) demo build dist site
