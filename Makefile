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
	$(BIN)/python -m pytest -n logical --dist loadfile --no-loadscope-reorder

quick: $(STAMP)
	$(BIN)/python -m pytest -n logical --dist loadfile --no-loadscope-reorder -m "not slow"

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

# Those alone that need neither scans nor a model of yours.
BENCHMARKS := $(filter-out $(foreach name,any_sensor frames realise learn_layout learn_drawn learn_judge learn_inside odd_things,benchmarks/$(name).py),\
                $(sort $(wildcard benchmarks/*.py)))
bench: $(STAMP)
	for script in $(BENCHMARKS); do $(BIN)/python $$script || exit 1; done

# The package as others get it, tried on every Python from 3.10 to 3.13 that is at hand: by its name, of pyenv or of uv.
# TORCH= leaves torch out and tries what does without it: the help of every verb, the reading of a scan.
TORCH ?= torch
wheel: $(STAMP)
	rm -rf dist
	$(BIN)/pip install --quiet --disable-pip-version-check build
	$(BIN)/python -m build --outdir dist .
	for v in 3.10 3.11 3.12 3.13; do \
	  python=; for found in python$$v $$(pyenv prefix $$v 2> /dev/null)/bin/python $$(uv python find $$v 2> /dev/null); do \
	    $$found -c "import sys; assert '%d.%d' % sys.version_info[:2] == '$$v'" 2> /dev/null && python=$$found && break; \
	  done; \
	  test -n "$$python" || { echo "Python $$v is not at hand: not tried"; continue; }; \
	  bash tests/wheel.sh $$python dist/$$v "$(TORCH)" || exit 1; \
	  echo "Python $$v: tried"; \
	done

# The documentation as a site, in site/; warnings are errors.
docs: $(STAMP)
	$(BIN)/pip install --quiet --disable-pip-version-check 'mkdocs-material>=9.5' 'mkdocstrings[python]>=0.26'
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) demo build dist site
