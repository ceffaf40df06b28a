# Everything runs in .venv, built here on first use; again when setup.py changes.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --use-pep517

# A shell that has sourced a ROS workspace, or runs inside another venv, must not leak into .venv.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Tests start hundreds of processes: without bytecode each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo quick tiers test studies check docs accuracy bench validate sdf explain-bench torture audit lock bag picture clean

## the main job on the shipped bag, live
demo: .venv/demo.stamp
	@$(BIN)/rov-ident demo

# Each worker takes a stretch of the tests, so that fixtures of modules are made once. Three, because
# tests of live nodes wait for half of their time.
PYTEST := $(BIN)/python -m pytest -n 3 --dist worksteal

## style, types, then all tests but the studies (15 minutes on two cores, with nothing compiled before)
test: check
	$(PYTEST) --timeout 900 -m "not study"

## the same tests with more seeds and vehicles
studies: .venv/test.stamp
	$(PYTEST) --timeout 1800 -m study

## the tests without DDS, programs and long computations (under 90 s, once all is compiled)
quick: .venv/test.stamp
	$(PYTEST) -n 2 --timeout 300 -m "not dds and not process and not slow and not study" \
	  --hypothesis-profile quick

## the tests of `make test`, measured: which of them `make quick` has time for (test/slow.txt)
tiers: .venv/test.stamp
	$(PYTEST) --timeout 900 -m "not study" --find-slow

## style and types
check: .venv/test.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

## the documentation as a site, out/docs/index.html; a broken link is an error
docs: .venv/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

## accuracy over seeds, the tables of docs/accuracy.md, and on data as vehicles give it (hours; it may
## be stopped and goes on where it was)
accuracy: .venv/demo.stamp
	$(BIN)/python -m bench.studies.accuracy
	$(BIN)/python -m bench.studies.at_sea

## speed against peers, the table of docs/speed.md (ten minutes; let nothing else run)
bench: .venv/bench.stamp
	@$(BIN)/python -m bench.studies.speed

## offline identification: the tables of docs/offline.md, docs/nomoto.md and docs/forces.md
validate: .venv/demo.stamp
	$(BIN)/python -m bench.studies.validate
	$(BIN)/python -m bench.studies.validate_nomoto
	$(BIN)/python -m bench.studies.validate_forces

## exported Gazebo models, read by libsdformat; needs the network
sdf: .venv/drake.stamp
	PYTHONPATH=.venv/drake $(BIN)/python -m bench.tools.sdf

# Apart from the rest, and without what it depends on: it is for this alone.
.venv/drake.stamp: .venv/demo.stamp
	@$(PIP) --no-deps --target .venv/drake drake
	@touch $@

## what goes wrong at sea, done to both estimators and to live nodes: docs/trust.md (some hours)
torture: .venv/test.stamp
	$(BIN)/python -m bench.studies.torture
	$(BIN)/python -m bench.studies.torture_live
	$(BIN)/python -m bench.studies.endurance
	$(BIN)/python -m bench.studies.fuzz
	$(BIN)/python -m bench.studies.fuzz_guided

## known faults of the dependencies, suspicious places in the source, and the list of what `make demo`
## installs (out/sbom.json, CycloneDX); needs the network
audit: .venv/audit.stamp
	@mkdir -p out
	.venv/audit/bin/bandit --quiet --configfile pyproject.toml --recursive rov_ident
	$(AUDIT) --requirement requirements/demo.txt --format cyclonedx-json --output out/sbom.json
	for name in test bench docs audit; do $(AUDIT) --requirement requirements/$$name.txt || exit 1; done

AUDIT := .venv/audit/bin/pip-audit --strict --disable-pip --no-deps

## the versions and hashes of all that this file installs, anew, for Python 3.10 to 3.13
lock: .venv/audit.stamp
	$(COMPILE) --extra wheels --extra test --output-file requirements/test.txt setup.py
	$(COMPILE) --extra wheels --constraint requirements/test.txt --output-file requirements/demo.txt setup.py
	for name in bench docs; do $(COMPILE) --extra wheels --extra $$name \
	  --constraint requirements/test.txt --output-file requirements/$$name.txt setup.py || exit 1; done
	printf 'bandit\npip-audit\nuv\n' | $(COMPILE) --output-file requirements/audit.txt -

COMPILE := .venv/audit/bin/uv pip compile --quiet --no-header --no-annotate --generate-hashes --upgrade \
  --universal --python-version 3.10

.venv/audit.stamp: requirements/audit.txt
	@$(PYTHON) -m venv .venv/audit
	@.venv/audit/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes \
	  --requirement requirements/audit.txt
	@touch $@

## how often explain finds what is hidden, the tables of docs/explain-bench.md (many hours; it may be
## stopped and goes on where it was)
explain-bench: .venv/demo.stamp
	$(BIN)/python -m bench.studies.explain
	$(BIN)/python -m bench.studies.explain_at_sea

## the shipped bag, anew
bag: .venv/demo.stamp
	$(BIN)/rov-ident simulate --config config/bluerov2_heavy.yaml --manoeuvre steps --seed 1 --duration 120 --out bags/demo.mcap

## the picture of `explain` in the README, anew
picture: .venv/demo.stamp
	$(BIN)/python -m bench.tools.picture

clean:
	rm -rf .venv build install log out *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis

# Locked versions, with their hashes, of requirements/$(1).txt; elsewhere what setup.py allows for $(2).
define install
if $(BIN)/python -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))'; then \
  $(PIP) --require-hashes --requirement requirements/$(1).txt && \
  $(PIP) --no-deps --no-build-isolation --editable .; \
else echo "The locks are for Python 3.10 to 3.13: what is installed now is not checked." >&2; \
  $(PIP) --editable '.[$(2)]'; fi
endef
comma := ,

# The stamps are written last: an interrupted installation is taken up again.
.venv/demo.stamp: setup.py
	@echo "Installing rov_ident into .venv (about a minute, 1 GB) ..." >&2
	@$(PYTHON) -m venv .venv
	@$(call install,demo,wheels)
	@touch $@

.venv/bench.stamp: .venv/demo.stamp
	@echo "Installing the peers into .venv ..." >&2
	@$(call install,bench,wheels$(comma)bench)
	@touch $@

.venv/docs.stamp: .venv/demo.stamp
	@echo "Installing mkdocs into .venv ..." >&2
	@$(call install,docs,wheels$(comma)docs)
	@touch $@

.venv/test.stamp: .venv/demo.stamp
	@echo "Installing the test tools into .venv ..." >&2
	@$(call install,test,wheels$(comma)test)
	@touch $@
