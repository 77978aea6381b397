# Each target installs what it needs into .venv, which a system Python's own rules don't touch.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test quick lint docs docs-open wheel bench integrations dataset clean

demo: .venv/core
	$(BIN)/khop run paper

test: .venv/test
	$(BIN)/python -m pytest -n auto --dist worksteal

quick: .venv/test
	$(BIN)/python -m pytest -n auto --dist worksteal -m quick

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

# The data set of examples/data, the same bytes again with the same versions
SMALL := examples/data/khop_small
dataset: .venv/core
	rm -rf $(SMALL)/leader_following $(SMALL)/navigation
	$(BIN)/khop evaluate leader_following_v0 --policies leader_following,random --observe estimate --network wifi,lossy:loss=0.3,burst=5 --episodes 5 --env max_cycles=80 --env bounds=true --record $(SMALL)/leader_following
	$(BIN)/khop evaluate navigation_v0 --scenario crossing:agents=4 --policies filter,go_to_goal,random --observe estimate --network wifi,lossy:loss=0.3,burst=5 --episodes 6 --env max_cycles=100 --env bounds=true --env control_period=0.1 --record $(SMALL)/navigation

# Libraries that learn, each in an environment of its own: make integration-rllib, ...; what it installs and how long it
# takes is said first. docs/guides/integrations.md has what each was seen to do with these versions.
INTEGRATIONS := agilerl benchmarl cleanrl pufferlib rllib tianshou torchrl
integrations: $(INTEGRATIONS:%=integration-%)

packages_agilerl = -e . agilerl==2.58.0 peft==0.21.2 transformers==5.24.0 gymnasium==1.4.0 pettingzoo==1.26.1
runs_agilerl = integrations/run_agilerl.py
needs_agilerl = 2.7 GB, 5 minutes

packages_benchmarl = -e . benchmarl==1.5.2 torchrl==0.11.1 gymnasium==1.4.0 pettingzoo==1.27.0
runs_benchmarl = integrations/run_benchmarl.py
needs_benchmarl = 1.6 GB, 5 minutes

packages_cleanrl = -e . torch
runs_cleanrl = learning/train_cleanrl_style.py
needs_cleanrl = 1.5 GB, 3 minutes

packages_pufferlib = -e . pufferlib-core==3.0.3 gymnasium==1.4.0 pettingzoo==1.27.0
runs_pufferlib = integrations/run_pufferlib.py
needs_pufferlib = 0.6 GB, 1 minute

packages_rllib = -e '.[ray,rl]' 'ray[rllib]==2.60.0' gymnasium==1.2.2 pettingzoo==1.27.0 torch
runs_rllib = integrations/run_rllib.py integrations/run_evaluation_on_ray.py integrations/run_sweep_on_ray.py \
	learning/train_rllib.py,--iterations,2 learning/train_rllib.py,--iterations,2,--per-type
needs_rllib = 2.2 GB, 8 minutes

packages_tianshou = -e . tianshou==2.0.1 gymnasium==1.4.0 pettingzoo==1.27.0
runs_tianshou = integrations/run_tianshou.py
needs_tianshou = 1.7 GB, 3 minutes

packages_torchrl = -e . torchrl==0.14.1 gymnasium==1.4.0 pettingzoo==1.27.0
runs_torchrl = integrations/run_torchrl.py \
	learning/train_torchrl.py,--iterations,3 learning/train_torchrl.py,--iterations,3,--ippo
needs_torchrl = 1.5 GB, 4 minutes

integration-%:
	@$(if $(packages_$*),,echo 'no integration $*; there are: $(INTEGRATIONS)'; exit 1)
	@echo "$*: installs $(packages_$*) and what they need into .peers/$*, if they aren't there, and runs"
	@for run in $(runs_$*); do echo "  examples/$$(echo $$run | tr , ' ')"; done
	@echo '  in all about $(needs_$*) on two cores'
	@$(MAKE) -s --no-print-directory .peers/$*/done
	@for run in $(runs_$*); do .peers/$*/bin/python examples/$$(echo $$run | tr , ' ') || exit 1; done

$(INTEGRATIONS:%=.peers/%/done): PACKAGES = $(packages_$*)
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
