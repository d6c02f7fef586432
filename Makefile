# make demo      set everything up and run the main job: simulate, replay through the four nodes, score, report
# make test      set everything up, check the code and run all tests
# make lint      style, types and layers alone
# make tests     all tests alone: types are known to the stubs of the newest libraries only
# make nightly   the long studies that "make test" has in a short form: many seeds, views and recordings
# make coverage  all tests, with the branch coverage of the core: less than 95 % fails
# make bench     accuracy and speed against OpenCV and a batch smoother, in the same run
# make faults    faults of IMU, camera, markers and nodes in flights of eight seeds, as a table for the documents
# make rigs      random rigs, rooms and motions from pictures on: medians, the worst, and which are beyond their claims
# make soak      an hour of flight in real time: memory, CPU and error by the minute
# make restart   how long a node that is killed in flight takes to be back
# make fuzz      10,000 mutated messages, files and bags for the nodes and commands; anything found is an error
# make latency   latency, losses and CPU of the nodes in real time, on the machine as it is and beside two busy loops
# make tables    put measured tables and parameters into the documents
# make structure print how large and how deep the package is, beside what it aims at
# make ablation  what each mechanism of detector, mapper and filter buys: figures with and without it
# make docs      build the documentation as a web site in build/site; a link that leads nowhere fails it
# make ready     install what all of these need, for several at a time
# make format    let ruff put the code into shape
# make clean     remove what these have made
PYTHON ?= $(firstword $(foreach version,3.12 3.11,$(if $(shell python$(version) -c 'import venv, ensurepip' 2>/dev/null && echo yes),python$(version))) python3)
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS := $(VENV)/.docs

# Traffic stays on this machine; small matrices are slower on many threads than on one.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# Dozens of processes start in the tests and nodes in a replay: without byte code each would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE
# A notice of the theme about its successor, and ten lines of setuptools about what an editable installation is.
export NO_MKDOCS_2_WARNING := 1
QUIET_PIP := PYTHONWARNINGS='ignore:Editable installation'
# A test that hangs ends with the stacks of its threads instead of the run; the longest takes 20 s, beside eight loops 3 min.
LIMIT := --timeout 600 --timeout-method thread

.PHONY: help demo test tests lint nightly coverage bench faults rigs soak restart fuzz latency tables structure ablation \
	ready docs format clean

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

$(READY): setup.py
	@echo '== Setting up $(VENV) with $(PYTHON), once: about 350 MB to download, 1.3 GB on the disk'
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)) and "Python 3.11 or 3.12 is needed: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip 'setuptools<80' wheel
	$(QUIET_PIP) $(BIN)/python -m pip install --progress-bar on --quiet --editable '.[ros,tools,batch,test,lint,colcon]'
	@touch $@

demo: $(READY)
	@echo '== Demo: a flight through fog, replayed through the four nodes'
	$(BIN)/python -m thermal_fiducial demo

lint: $(READY)
	@echo '== Style, types, layers'
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint tests

tests: $(READY)
	@echo '== Tests (real data are used where THERMAL_FIDUCIAL_DATA names their folder)'
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal $(LIMIT) --durations 15 $(PYTEST_ARGS)

nightly: $(READY)
	@echo '== Studies of many flights, views and recordings, beside what make test runs'
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal -m nightly --durations 15 $(PYTEST_ARGS)

coverage: $(READY)
	@echo '== Tests, and the branch coverage of the core by its own (test/conftest.py)'
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal $(LIMIT) --cov thermal_fiducial.core --cov-branch \
		--cov-report term-missing:skip-covered --cov-fail-under 95 $(PYTEST_ARGS)

bench: $(READY)
	@echo '== Benchmarks, one thread'
	$(BIN)/python -m pytest test/bench -m '' --benchmark-only --benchmark-columns=median,min,max,rounds $(PYTEST_ARGS)

faults: $(READY)
	@echo '== Faults in flight: about an hour on two cores; fewer flights: make faults FAULTS_ARGS="--seeds 1"'
	PYTHONPATH=test $(BIN)/python -m faults $(FAULTS_ARGS); ended=$$?; $(BIN)/python test/documents.py && exit $$ended

rigs: $(READY)
	@echo '== Random rigs from pictures on: a minute each on a core; other seeds: make rigs RIGS_ARGS="20 100"'
	PYTHONPATH=test $(BIN)/python -m rigs $(or $(RIGS_ARGS),0 20)

soak: $(READY)
	@echo '== An hour of flight in real time; shorter: make soak SOAK_ARGS="--minutes 6"'
	PYTHONPATH=test $(BIN)/python -m soak $(SOAK_ARGS)

restart: $(READY)
	@echo '== Nodes killed in flight, one after another'
	PYTHONPATH=test $(BIN)/python test/restart.py

fuzz: $(READY)
	@echo '== Mutated messages, files and bags'
	PYTHONPATH=test $(BIN)/python -m fuzz $(FUZZ_ARGS)

latency: $(READY)
	@echo '== Latency: one process a node, in real time; the idle row needs an idle machine'
	$(BIN)/python test/latency.py $(LATENCY_ARGS)
	$(BIN)/python test/documents.py

tables: $(READY)
	THERMAL_FIDUCIAL_TABLES=1 $(BIN)/python -m pytest --quiet -m '' test/real
	$(BIN)/python test/documents.py

$(DOCS): setup.py $(READY)
	$(QUIET_PIP) $(BIN)/python -m pip install --quiet --editable '.[docs]'
	@touch $@

structure: $(READY)
	$(BIN)/python test/structure.py

ablation: $(READY)
	$(BIN)/python test/ablation.py
	$(BIN)/python test/mapper_ablation.py
	$(BIN)/python test/filter_ablation.py

# All that the others install, for runs in parallel: none may find half of it.
ready: $(READY) $(DOCS)

docs: $(DOCS)
	@echo '== Documentation: build/site/index.html'
	$(BIN)/python -m mkdocs build --strict --quiet

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build install log runs *.egg-info .mypy_cache .ruff_cache .import_linter_cache .pytest_cache .hypothesis \
		.benchmarks .coverage htmlcov
