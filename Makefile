# Two commands for a new user: `make demo` and `make test`. On a bare machine: Python 3.11 and nothing else.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
BIN    := $(VENV)/bin

# The base interpreter's pip installs into the environment, which then need not hold a copy of it.
BASE_PIP := $(shell $(PYTHON) -m pip --version >/dev/null 2>&1 && echo yes)
PIP       = $(if $(BASE_PIP),$(PYTHON) -m pip --python $(BIN)/python,$(BIN)/python -m pip) \
            install --quiet --disable-pip-version-check --root-user-action=ignore

# Real terrain needs a raster library; it is installed only if real data are available.
DEMO_STAMPS := $(VENV)/.runtime $(if $(LINNA_DATA),$(VENV)/.terrain)
DEMO_OUT    ?= linna-demo


# An environment that is a link belongs to another checkout: it is used as it is, nothing is installed into it.
LINKED := $(shell test -L $(VENV) && echo yes)

# Mutants of each group that `make mutation` tests; 0: every one.
SAMPLE ?= 60
SEED   ?= 1

# What is shipped: installed with hashes, audited, listed with licences.
SHIPPED := $(foreach name,runtime postgres parquet traces oidc objects terrain exports,requirements/$(name).txt)
HASHED  := $(SHIPPED:requirements/%=requirements/hashed/%)

.PHONY: demo test test-cost campaigns-left clean-campaigns check openmct docs pictures page-table sbom licences package release bench campaigns mutation up install install-dev clean

demo: $(DEMO_STAMPS)
	$(BIN)/linna demo --out $(DEMO_OUT)

# Compiled modules are kept, whatever the environment says: many tests start processes.
SUITE = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test: $(VENV)/.dev
	$(SUITE)

# Long campaigns; each has a short twin in `make test` (tests/campaigns.csv). A run that was stopped goes on with the files
# that have not passed; `make campaigns-left` lists them, and `make clean-campaigns` forgets what has passed.
campaigns: $(VENV)/.dev
	$(SUITE) -m campaign --resume
	$(BIN)/python -m benchmarks.campaigns.compatibility --write
	$(MAKE) test-cost

campaigns-left: $(VENV)/.dev
	$(BIN)/python -m pytest -m campaign --resume --collect-only -q

clean-campaigns:
	rm -rf build/campaigns.txt build/compatibility/results

# Processor time of the newest complete `make test` by folder, compared with tests/cost.csv.
test-cost: $(VENV)/.dev
	test -f build/test-cost.csv || $(SUITE)
	$(BIN)/python -m tests.cost

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(PYTHON) -m pip --python $(BIN)/python check
	$(BIN)/python -m pytest -q tests/test_dependencies.py
	$(BIN)/python deploy/materials.py audit $(SHIPPED)

# The documentation site with executed notebooks; `linna serve` shows it at /help, wheel and image contain it.
docs: $(VENV)/.dev
	$(BIN)/python docs_site.py notebooks build/notebooks
	NO_MKDOCS_2_WARNING=1 NOTEBOOK_OUTPUTS=build/notebooks $(BIN)/python -m mkdocs build --strict

# Telemetry displays; `linna serve` shows them at /mct. The lock file states version and checksum.
openmct: deploy/openmct/node_modules/.package-lock.json

deploy/openmct/node_modules/.package-lock.json: deploy/openmct/package.json deploy/openmct/package-lock.json
	npm ci --prefix deploy/openmct --ignore-scripts --no-audit --no-fund
	touch $@

# Pictures of the README and of the pages, over the real terrain of LINNA_DATA: of a demo, of a build that is compared on
# its pass, and of a living demo. Those of a flight over the procedural Moon, and of a telephone, are taken by tests.
STRICT = 'schema_version = 1\nname = "strict detector"\nversion = "1.0.0"\nparameters = "parameters.toml"\n'
pictures: $(VENV)/.dev
	rm -rf build/tour && mkdir -p build/tour
	echo 'detector.score_threshold = 0.8' > build/tour/parameters.toml
	printf $(STRICT) > build/tour/build.toml
	cd build/tour && ../../$(BIN)/linna demo --out linna-demo > demo.txt
	cd build/tour && ../../$(BIN)/linna regress run --archive linna-demo/pass --build build.toml --home linna-demo/ground || test $$? = 1
	$(BIN)/python docs_site.py shift build/tour/living
	$(BIN)/python docs_site.py tour build/tour
	LINNA_PICTURES=docs/pictures $(BIN)/python -m pytest -q -m "campaign or not campaign" tests/ground_service/web/test_flight.py \
	  tests/ground_service/web/test_page_state.py -k "flight or planner_opens"

# Table of the pages by width, colours, font and data, written by the test of all pages.
page-table: $(VENV)/.dev
	LINNA_PAGE_TABLE=docs/results/pages.md $(BIN)/python -m pytest -q -m campaign tests/ground_service/web/test_matrix.py

# Bill of materials of what is shipped (CycloneDX): hashes, licences, dependencies, telemetry displays. STATUS names a
# copy of /var/lib/dpkg/status of the image, for its Debian packages.
sbom: $(VENV)/.dev
	mkdir -p dist
	$(BIN)/python deploy/materials.py bom $(HASHED) $(if $(STATUS),--status $(STATUS)) > dist/linna.cdx.json

# Licences of everything that is shipped; fails if one is GPL or AGPL.
licences: $(VENV)/.dev
	$(BIN)/python deploy/materials.py licences $(SHIPPED)

# Wheel, source distribution, bill of materials, licences, checksums and their signature, in a new folder. LINNA_RELEASE_KEY
# names the private key, outside of the repository; `openssl genpkey -algorithm ed25519` makes one.
release: docs
	@test -n "$(LINNA_RELEASE_KEY)" || { echo "LINNA_RELEASE_KEY: expected the file of the private key, found none" >&2; exit 2; }
	rm -rf dist/release
	mkdir -p dist/release
	SOURCE_DATE_EPOCH="$$(git log -1 --format=%ct)" $(BIN)/python -m build --outdir dist/release
	SOURCE_DATE_EPOCH="$$(git log -1 --format=%ct)" sh deploy/reproducible.sh dist/release/*.tar.gz
	$(BIN)/python deploy/materials.py bom $(HASHED) --wheel dist/release/*.whl > dist/release/linna.cdx.json
	$(BIN)/python deploy/materials.py licences $(SHIPPED) > dist/release/licences.txt
	sh deploy/release.sh sign dist/release "$(LINNA_RELEASE_KEY)"

# Wheel and source distribution, with the documentation.
package: docs
	$(BIN)/python -m build --outdir dist

bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks $(if $(BEFORE),--before $(BEFORE))

mutation: $(VENV)/.mutation
	$(BIN)/python -m benchmarks.mutation --sample $(SAMPLE) --seed $(SEED) $(if $(GROUP),--group $(GROUP))

up:
	sh deploy/secrets.sh
	docker compose up --build

install: $(DEMO_STAMPS)
install-dev: $(VENV)/.dev

ifeq ($(LINKED),)
$(BIN)/python:
	$(PYTHON) -m venv $(if $(BASE_PIP),--without-pip) $(VENV)

$(VENV)/.runtime: requirements/hashed/runtime.txt pyproject.toml | $(BIN)/python
	$(PIP) --no-compile --require-hashes -r requirements/hashed/runtime.txt
	$(PIP) --no-deps --editable .
	touch $@

$(VENV)/.terrain: requirements/hashed/terrain.txt $(VENV)/.runtime
	$(PIP) --no-compile --require-hashes --no-deps -r requirements/hashed/terrain.txt
	touch $@

$(VENV)/.dev: requirements/dev.txt requirements/train.txt requirements/postgres.txt requirements/parquet.txt requirements/traces.txt requirements/oidc.txt requirements/objects.txt requirements/exports.txt requirements/docs.txt $(VENV)/.runtime $(VENV)/.terrain
	$(PIP) -r requirements/runtime.txt -r requirements/postgres.txt -r requirements/parquet.txt -r requirements/traces.txt -r requirements/oidc.txt -r requirements/objects.txt -r requirements/exports.txt -r requirements/train.txt -r requirements/docs.txt -r requirements/dev.txt
	touch $@

$(VENV)/.bench: requirements/bench.txt $(VENV)/.dev
	$(PIP) -r requirements/bench.txt
	touch $@

$(VENV)/.mutation: requirements/mutation.txt $(VENV)/.dev
	$(PIP) -r requirements/mutation.txt
	touch $@

else
$(VENV)/%: ;
endif

clean:
	rm -rf $(VENV) build dist *.egg-info linna-demo deploy/openmct/node_modules
