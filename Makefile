# Each target installs what it needs into .venv, which a system Python's own rules don't touch.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test quick lint docs docs-open wheel bench integrations dataset clean

demo: .venv/core
	$(BIN)/khop run paper

test: .venv/test
	$(BIN)/python -m pytest -n auto

quick: .venv/test
	$(BIN)/python -m pytest -n auto -m quick

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: .venv/docs
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html
	@echo 'docs/_build/html/index.html'

docs-open: docs
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory docs/_build/html 8000

# Wheel and source distribution in dist/, tried on the oldest and the newest supported Python found (a minute)
wheel: .venv/build
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python tests/packaging/try_wheel.py dist

# PEERS=1 installs what environments are compared with, each in an environment of its own (gigabytes, minutes)
bench: .venv/bench $(if $(PEERS),.peers/mpe2/done .peers/vmas/done .peers/jaxmarl/done)
	$(BIN)/khop bench $(if $(PEERS),--peers .peers)

# RLlib, TorchRL and Tianshou with the environments, evaluation on Ray, and short trainings, each library in an environment of its own (minutes)
integrations: .peers/rllib/done .peers/torchrl/done .peers/tianshou/done
	for name in rllib torchrl tianshou; do .peers/$$name/bin/python examples/integrations/run_$$name.py || exit 1; done
	.peers/rllib/bin/python examples/integrations/run_evaluation_on_ray.py
	for how in '' --per-type; do .peers/rllib/bin/python examples/learning/train_rllib.py --iterations 2 $$how || exit 1; done
	for how in '' --ippo; do .peers/torchrl/bin/python examples/learning/train_torchrl.py --iterations 3 $$how || exit 1; done

# The data set of examples/data, the same bytes again with the same versions
SMALL := examples/data/khop_small
dataset: .venv/core
	rm -rf $(SMALL)/leader_following $(SMALL)/navigation
	$(BIN)/khop evaluate leader_following_v0 --policies leader_following,random --observe estimate --network wifi,lossy:loss=0.3,burst=5 --episodes 5 --env max_cycles=80 --env bounds=true --record $(SMALL)/leader_following
	$(BIN)/khop evaluate navigation_v0 --scenario crossing:agents=4 --policies filter,go_to_goal,random --observe estimate --network wifi,lossy:loss=0.3,burst=5 --episodes 6 --env max_cycles=100 --env bounds=true --env control_period=0.1 --record $(SMALL)/navigation

.peers/rllib/done: PACKAGES = -e '.[ray]' torch
.peers/torchrl/done: PACKAGES = -e . 'torchrl>=0.14'
.peers/tianshou/done: PACKAGES = -e . 'tianshou>=2.0'
.peers/mpe2/done: PACKAGES = mpe2 pygame-ce supersuit stable-baselines3 torch
.peers/vmas/done: PACKAGES = vmas torch
.peers/jaxmarl/done: PACKAGES = jaxmarl jax
.peers/%/done: constraints.txt
	$(PYTHON) -m venv .peers/$*
	.peers/$*/bin/python -m pip install --quiet -c constraints.txt $(PACKAGES)
	touch $@

clean:
	rm -rf .venv .peers runs dist docs/_build
	find . -name __pycache__ -prune -exec rm -rf {} +

.venv/core: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "khop_env needs Python 3.11 or newer: make PYTHON=python3.12 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

.venv/build: .venv/core
	$(BIN)/python -m pip install --quiet -c constraints.txt 'build>=1.2'
	touch $@

.venv/test .venv/bench .venv/dev .venv/docs: .venv/%: .venv/core pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[$*]'
	touch $@
