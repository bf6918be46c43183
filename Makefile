# Every target makes the virtual environment it needs. `make help` lists them; ARGS="..." is passed on.

# The first interpreter that runs and is new enough (3.11 is the one most tested).
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
RUN := $(VENV)/bin/python
BASE := $(VENV)/.base
DEV := $(VENV)/.dev
PARITY := $(VENV)/.parity
DOCS := $(VENV)/.docs
# The compiler of GPUs has an environment of its own: beside it JAX would look for a GPU.
AOT_VENV := .venv-aot
AOT := $(AOT_VENV)/.aot
CODE := roge_jax tests experiments
# Programs of the experiments; stored sampling grids come first, because the charts use them. Left out: what `figures`
# only draws, comparisons with PyTorch (`make compare`), what needs the compiler of GPUs, and what needs scenes of your own.
EXPERIMENTS := $(subst /,.,$(basename $(shell grep -l '^if __name__' experiments/*/*.py)))
DRAWN := experiments.quality.training_curves
COMPARISONS := experiments.speed.dit experiments.speed.vae experiments.speed.real_size
COMPILED := experiments.scaling.compiled
# Pages that are made from the code, and their drawings.
GENERATED := experiments.pages.options experiments.pages.messages experiments.pages.modules \
	experiments.pages.diagrams experiments.pages.evaluations
HERO := experiments.pages.hero
FIRST := experiments.quality.optimise_schedules
# Of scenes that nobody has unless he says where.
GIVEN := experiments.quality.pose
FIGURES := $(FIRST) $(patsubst %.__main__,%,$(filter-out $(FIRST) $(DRAWN) $(COMPARISONS) $(COMPILED) $(GENERATED) $(HERO) $(GIVEN),$(EXPERIMENTS)))
# Workers take over each other's tests at the end, so that none waits for one long file. Lines end in tests done of all.
PYTEST := $(RUN) -m pytest -n auto --maxprocesses 8 --dist worksteal -o console_output_style=count --durations 8

.DEFAULT_GOAL := help
.PHONY: help sample train evaluate smoke test test-slow test-parity test-accelerators scaling check lint format figures compare notebook docs clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

sample: $(BASE)  ## two real photos in, the video along a path out (outputs/sample)
	$(RUN) -m roge_jax.sample --out outputs/sample $(ARGS)

train: $(BASE)  ## train the shipped model further, end to end and to larger pictures, into a new folder under runs/
	$(RUN) -m roge_jax.train mini --stage joint --size 96x160 --evaluate-every 20 --out runs/$(shell date +%Y%m%d-%H%M%S) $(ARGS)

evaluate: $(BASE)  ## the shipped model beside its baselines on held-out scenes
	$(RUN) -m roge_jax.evaluate --scenes procedural:1000000000..1000000009 --out outputs/results.json $(ARGS)

smoke: $(BASE)  ## both programs on tiny sizes and random weights
	$(RUN) -m roge_jax.train tiny --steps 2 --out runs/smoke-$(shell date +%Y%m%d-%H%M%S)
	$(RUN) -m roge_jax.sample --dry-run $(ARGS)

test: $(DEV)  ## the fast tests
	$(PYTEST) $(ARGS)

test-slow: $(DEV)  ## tests that take minutes or gigabytes, one after another; says how long each took
	$(RUN) -m pytest -m slow -o console_output_style=count --durations 20 $(ARGS)

test-parity: $(PARITY)  ## tests against PyTorch implementations (installs torch and diffusers)
	$(RUN) -m pytest -q -m parity $(ARGS)

test-accelerators: $(AOT)  ## programs compiled for GPUs that need not be there (installs their compiler, 0.6 GB)
	$(AOT_VENV)/bin/python -m pytest -q tests/core/test_aot.py $(ARGS)

scaling: $(AOT)  ## what the compiler of GPUs says of every program (hours on two cores); writes experiments/results and docs/results/scaling.md
	$(AOT_VENV)/bin/python -m $(COMPILED) $(ARGS)
	$(AOT_VENV)/bin/python -m experiments.scaling.layouts

check: lint test  ## what CI runs

lint: $(DEV)  ## ruff and mypy, nothing is changed
	$(VENV)/bin/ruff check $(CODE)
	$(VENV)/bin/ruff format --check $(CODE)
	$(VENV)/bin/mypy

format: $(DEV)  ## let ruff order imports and lay out the code
	$(VENV)/bin/ruff check --fix $(CODE)
	$(VENV)/bin/ruff format $(CODE)

figures: $(DEV)  ## every chart and table again; writes experiments/results (hours; docs/development/figures.md has single ones)
	$(RUN) -m roge_jax.evaluate --size 64x112 --out experiments/results/mini_procedural.json --sheet docs/media/mini_procedural.png
	$(RUN) -m roge_jax.evaluate --sweep 100 130 --size 64x112 --out experiments/results/mini_wide.json
	$(RUN) -m roge_jax.procedural sheet --out docs/media/procedural.png
	$(RUN) -m $(DRAWN) --draw
	@for f in $(FIGURES); do echo "== $$f"; $(RUN) -m $$f || exit 1; done

compare: $(PARITY)  ## speed beside PyTorch (installs torch and diffusers); writes experiments/results
	@for f in $(COMPARISONS); do echo "== $$f"; $(RUN) -m $$f || exit 1; done

notebook: $(DEV)  ## run the notebook and store its pictures in notebooks/from_rays_to_video.ipynb
	$(VENV)/bin/jupytext --update --to ipynb notebooks/from_rays_to_video.py
	$(RUN) -m nbconvert --to notebook --execute --inplace --ExecutePreprocessor.record_timing=False \
		notebooks/from_rays_to_video.ipynb

docs: $(DOCS)  ## the pages as a site (outputs/site/index.html), made from the code where they are made from it
	@for page in $(GENERATED); do $(RUN) -m $$page || exit 1; done
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict $(ARGS)

clean:  ## remove caches (not runs, outputs or the environment)
	rm -rf .jax_cache .pytest_cache .ruff_cache .mypy_cache .hypothesis

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer found: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(BASE): pyproject.toml | $(VENV)/bin/python
	$(RUN) -m pip install --quiet --editable .
	@touch $@

$(DEV): pyproject.toml | $(VENV)/bin/python
	$(RUN) -m pip install --quiet --editable '.[dev]'
	@touch $@ $(BASE)

$(AOT): pyproject.toml
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer found: make PYTHON=/path/to/python3.11"; exit 1; }
	@test -x $(AOT_VENV)/bin/python || $(PYTHON) -m venv $(AOT_VENV)
	$(AOT_VENV)/bin/python -m pip install --quiet --editable '.[aot]' pytest pytest-xdist hypothesis beartype
	@touch $@

$(DOCS): pyproject.toml | $(VENV)/bin/python
	$(RUN) -m pip install --quiet --editable '.[docs]'
	@touch $@ $(BASE)

$(PARITY): pyproject.toml | $(VENV)/bin/python
	$(RUN) -m pip install --quiet --editable '.[dev,parity]'
	@touch $@ $(DEV) $(BASE)
