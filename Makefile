# The two commands of the README are `make demo` and `make test`. They need Python 3.11 or newer and make.

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
INSTALLED := .venv/.installed
WHEEL_VENV := build/wheel-venv
PYTEST_ARGS ?= -n auto --dist worksteal

WORKERS ?= 2

.PHONY: help demo test unit slow wheel lint docs docs-serve coverage tables-airme tables-murse format clean

help: ## what there is to make
	@grep -hE '^[a-z%-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z%-]+):.*## (.*)/  \1|\2/' | column -t -s '|'

demo: $(INSTALLED) ## seven crews as processes for thirty days, compared with central schedulers; writes out/demo/
	$(BIN)/marl-sched demo

test: unit wheel ## tests of a few seconds each, then the wheel in a second environment

unit: $(INSTALLED) ## the tests alone; PYTEST_ARGS="-k noise" are pytest's, by default those that use every core
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "not slow" $(PYTEST_ARGS)

slow: $(INSTALLED) ## tests that take longer: campaigns of faults, tutorials, thousands of problems, index checks
	OMP_NUM_THREADS=1 $(BIN)/pytest -m slow $(PYTEST_ARGS)

# The second environment borrows the dependencies of the first through a .pth file; the editable install does not
# come along, since .pth files are not read from there. The wheel must do without the checkout.
wheel: $(INSTALLED) ## the wheel in a second environment
	rm -rf build
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/wheel .
	$(BIN)/python -m venv --without-pip $(WHEEL_VENV)
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
		> "$$($(WHEEL_VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/dependencies.pth"
	$(BIN)/python -m pip --python $(WHEEL_VENV) install --quiet --no-deps --no-index build/wheel/*.whl
	cd $(WHEEL_VENV) && bin/marl-sched --version && bin/marl-sched list
	cd $(WHEEL_VENV) && bin/python -c "from marl_sched.train.config import load_config; load_config([])" # the YAML ships

lint: $(INSTALLED) ## style, formatting, spelling, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/mypy -p marl_sched

docs: export NO_MKDOCS_2_WARNING = 1
docs: $(INSTALLED) ## the documentation site in build/site/, every warning an error
	$(BIN)/python -m mkdocs build

docs-serve: $(INSTALLED) ## the same on localhost, renewed with every change
	$(BIN)/python -m mkdocs serve

coverage: $(INSTALLED) ## which lines of what is not compiled no test runs, in build/coverage/
	OMP_NUM_THREADS=1 $(BIN)/pytest --cov --cov-report=term:skip-covered \
		--cov-report=html:build/coverage $(PYTEST_ARGS)

tables-murse: $(INSTALLED) ## the page about MuRSE in docs/results/, only the cells that are missing
	$(BIN)/marl-sched tables --env murse --workers $(WORKERS) $(if $(QUICK),--quick)

tables-airme: $(INSTALLED) ## tables 6.2 to 6.4 in docs/results/, only the cells that are missing; QUICK=1: a look, in out/tables/
	$(BIN)/marl-sched tables --env airme --workers $(WORKERS) $(if $(QUICK),--quick)

# Shipped policies: `make policy-NAME` trains one again, in runs/, and measures it for its card. The same seed on
# another processor may differ in the last digits of a sum, and then in what is learned from it.
TRAIN_airme-full-profit := algorithm=imitation updates=500
TRAIN_airme-full-revenue := algorithm=imitation updates=400 env.objective=revenue
TRAIN_airme-full-availability := algorithm=imitation updates=400 env.objective=availability
TRAIN_airme-local-profit := algorithm=imitation updates=400 view=local
TRAIN_airme-local-revenue := algorithm=imitation updates=400 view=local env.objective=revenue
TRAIN_airme-local-availability := algorithm=imitation updates=400 view=local env.objective=availability
TRAIN_airme-any-profit := algorithm=imitation updates=500 view=random
STALE := view=local view.staleness=12

# Trains the run of the first name by the overrides behind it, or goes on with it where it was stopped.
trained = if test -e runs/$(1)/config.json; then $(BIN)/marl-sched resume runs/$(1); else \
	$(BIN)/marl-sched train $(2) run_dir=runs/$(1); fi

policy-%: $(INSTALLED) ## trains a shipped policy again and writes it into agents/policies/shipped/
	$(call trained,$*,$(or $(TRAIN_$*),$(error no policy is called $*)))
	$(BIN)/marl-sched export runs/$* $* --out agents/policies/shipped --episodes 1

# With stale information imitation alone is not enough: what is worth doing depends on what the neighbours do.
policy-airme-stale-profit: $(INSTALLED)
	$(call trained,airme-stale-imitation,$(STALE) algorithm=imitation updates=400)
	$(call trained,airme-stale-worth,$(STALE) algorithm=imitation algorithm.criterion=expected_advantage \
		algorithm.temperature=0.1 algorithm.final_temperature=0.01 algorithm.learning_rate=2e-3 updates=100 \
		start_from=runs/airme-stale-imitation/policy.safetensors)
	$(call trained,airme-stale-profit,$(STALE) algorithm.ppo.critic_warmup=0.05 algorithm.ppo.policy_rate=0.1 \
		algorithm.ppo.entropy=0.0 updates=350 start_from=runs/airme-stale-worth/policy.safetensors)
	$(BIN)/marl-sched export runs/airme-stale-profit airme-stale-profit --out agents/policies/shipped --episodes 1

# MuRSE: first what a roll-out of the latest-start rule would choose, then what choices cost on average, so that one is
# surely made. A teacher that sees everything does not know which tasks will be in nobody's sight, so a policy for local
# views also learns from the best of its own episodes. Each target takes less than half an hour of one core.
MURSE := env=murse policy=hetgat_residual curriculum=rounds 'env.scales=[small,medium]' validation.every=10
TAUGHT := $(MURSE) algorithm=rollout_imitation
PLANNED := $(TAUGHT) curriculum.start=1 curriculum.stop=1 +env.options.durations=deterministic validation.length=1
COSTS := algorithm.criterion=expected_cost algorithm.final_temperature=0.002 validation.baseline=lst
ONLINE := view=local +env.options.mode=online +env.options.durations=stochastic validation.instances=40 \
	validation.length=3 validation.baseline=lst

policy-murse-full-makespan: $(INSTALLED)
	$(call trained,murse-full-imitation,$(PLANNED) updates=80 validation.instances=100)
	$(call trained,murse-full-makespan,$(PLANNED) $(COSTS) algorithm.temperature=0.01 algorithm.learning_rate=1e-3 \
		validation.instances=150 updates=120 start_from=runs/murse-full-imitation/policy.safetensors)
	$(BIN)/marl-sched export runs/murse-full-makespan murse-full-makespan --out agents/policies/shipped \
		--scales small,medium,large --episodes 1 --length 1

policy-murse-local-makespan: policy-murse-full-makespan
	$(call trained,murse-local-costs,$(TAUGHT) $(ONLINE) $(COSTS) algorithm.teacher=lst-robust-rollout \
		algorithm.temperature=0.005 algorithm.learning_rate=5e-4 updates=60 \
		start_from=runs/murse-full-makespan/policy.safetensors)
	$(call trained,murse-local-makespan,$(MURSE) $(ONLINE) curriculum.start=1 curriculum.stop=1 \
		algorithm=self_labelling algorithm.episodes=16 algorithm.learning_rate=5e-4 updates=80 seed=1 \
		start_from=runs/murse-local-costs/policy.safetensors)
	$(BIN)/marl-sched export runs/murse-local-makespan murse-local-makespan --out agents/policies/shipped \
		--scales small,medium,large --instances 30 --episodes 1

# Chapters 3 and 4: networks that plan step by step, on the costs of their own steps. Each takes about a quarter of an hour
# of one core.
STEPS := env=murse algorithm=explored_steps curriculum=rounds curriculum.start=1 curriculum.stop=1 validation.every=25 \
	validation.length=1 validation.baseline=lst algorithm.minibatch=64
TRAIN_schedulenet := $(STEPS) policy=schedulenet updates=400 algorithm.instances=16 validation.instances=40 'env.scales=[homogeneous-10-small,$(strip \
	)heterogeneous-10-small,homogeneous-10-medium,heterogeneous-5-small,heterogeneous-10-medium]'
TRAIN_robognn := $(STEPS) policy=robognn updates=300 algorithm.instances=12 validation.instances=30 'env.scales=[robots-small]'
TRAIN_homgnn-10 := $(STEPS) policy=robognn updates=60 algorithm.instances=12 validation.instances=30 'env.scales=[homogeneous-10-small]'
SCALES_schedulenet := homogeneous-10-small,homogeneous-10-medium,heterogeneous-10-small,heterogeneous-10-medium
SCALES_robognn := robots-small,robots-medium
SCALES_homgnn-10 := homogeneous-10-small

policy-schedulenet policy-robognn policy-homgnn-10: policy-%: $(INSTALLED)
	$(call trained,$*,$(TRAIN_$*))
	$(BIN)/marl-sched export runs/$* $* --out agents/policies/shipped --scales $(SCALES_$*) --episodes 1 --length 1

# Chapter 5: networks that plan whole rounds pair by pair. HybridNet learns first what pairs cost if the rule completes the
# rest, then by PPO with a greedy rollout baseline (algorithm 4). Each target takes less than half an hour of one core.
PAIRS := env=murse curriculum=rounds curriculum.start=1 curriculum.stop=1 device=cpu +env.options.durations=deterministic \
	validation.length=1 validation.baseline=lst
COSTS_OF_PAIRS := $(PAIRS) algorithm=choice_costs algorithm.criterion=expected_cost algorithm.temperature=0.015 \
	algorithm.final_temperature=0.002 algorithm.learning_rate=3e-3

policy-hybridnet: $(INSTALLED)
	$(call trained,hybridnet-costs,$(COSTS_OF_PAIRS) policy=hybridnet 'env.scales=[small,medium]' updates=350 \
		algorithm.epochs=2 validation.every=50 validation.instances=150)
	$(call trained,hybridnet,$(PAIRS) algorithm=greedy_rollout policy=hybridnet 'env.scales=[small,medium]' updates=80 \
		algorithm.learning_rate=5e-4 validation.every=20 validation.instances=150 \
		start_from=runs/hybridnet-costs/policy.safetensors)
	$(BIN)/marl-sched export runs/hybridnet hybridnet --out agents/policies/shipped --scales small,medium,large \
		--instances 60 --episodes 1 --length 1

policy-hetgat-interactive: $(INSTALLED)
	$(call trained,hetgat-interactive,$(COSTS_OF_PAIRS) policy=hetgat_interactive policy.width=8 policy.heads=2 \
		'env.scales=[small]' updates=150 algorithm.instances=12 algorithm.epochs=1 algorithm.temperature=0.01 \
		algorithm.learning_rate=5e-3 validation.every=20 validation.instances=60)
	$(BIN)/marl-sched export runs/hetgat-interactive hetgat-interactive --out agents/policies/shipped \
		--scales small,medium,large --episodes 1 --length 1 --instances 40

format: $(INSTALLED) ## sort imports and lay out the code
	$(BIN)/ruff check --select I --fix .
	$(BIN)/ruff format .

clean: ## remove everything that these commands made, results in out/ excepted
	rm -rf .venv build dist .mypy_cache .pytest_cache .ruff_cache *.egg-info

$(INSTALLED): pyproject.toml setup.py constraints.txt
	@test -n "$(PYTHON)" || { echo "marl_sched needs Python 3.11 or newer: make PYTHON=/path/to/python" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all,test,docs]'
	touch $@
