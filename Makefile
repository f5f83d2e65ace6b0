# Every target sets up what it needs: a machine with Python 3.11 and make is enough
# (`readme` also needs a Chromium, `reports-learn-speed-gpu` a GPU).
PYTHON ?= python3.11
VENV ?= .venv
BIN = $(VENV)/bin
SCENE ?= 3ladder

# One thread a process: parallel work runs in processes.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

# Many short processes import the package: it is compiled once, also where that is switched off.
unexport PYTHONDONTWRITEBYTECODE

comma = ,

# One at a time: the reports measure times.
.NOTPARALLEL:
.PHONY: validate test fuzz lint package docs clean reports reports-validate \
	reports-tradeoff reports-stability reports-ablation reports-overhead \
	reports-learn-speed reports-learn-speed-gpu reports-shift reports-lite reports-models reports-models-in-the-wild \
	reports-data \
	reports-data-full reports-paper-tables reports-releases reports-pages pictures readme study

validate: $(VENV)/ready
	$(BIN)/mbds-xsim validate $(SCENE) --json out/$(SCENE).json --html out/$(SCENE).html

test: $(VENV)/ready
	MBDS_XSIM_MUST_RUN=mujoco,pybullet,dart,exudyn,pinocchio,mujoco-warp,drake $(BIN)/python -m pytest \
		--numprocesses logical --dist worksteal

# Seven times the cases of bad input that the tests have, new ones each time.
FUZZ ?= 3000
fuzz: $(VENV)/ready
	MBDS_XSIM_FUZZ=$(FUZZ) $(BIN)/python -m pytest tests/fuzz

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

package: $(VENV)/ready
	rm -rf dist
	$(BIN)/python -m build --wheel --outdir dist . >/dev/null
	$(BIN)/check-wheel-contents dist/*.whl

# The pages as a site in out/site; a link that leads nowhere is an error.
docs: $(VENV)/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	# Two pip processes at a time; the pinned packages fit together, so none are resolved.
	grep -v '^#' constraints.txt | xargs -P 2 -n 34 \
		$(BIN)/python -m pip install --quiet --no-compile --no-deps
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev]'
	touch $@

# Most reports again, in a day or two on a machine that does nothing else. A chapter has its own
# target; options for a quick look:
# make reports-tradeoff reports-stability REPORTS=out/reports SCENES=5pendulum \
#     TRADEOFF="--starts 1 --limit 2" STUDIES=spin STABILITY=--quick
REPORTS ?= reports
STARTS ?= 20
SCENES ?= 5pendulum 6pendulum 2ladder 3ladder ballscroll balldrop particlecar simplecubli
STUDIES ?= scenes mass-ratio chain-length loops redundancy singular stiffness spin wheels throw \
	swing pace links friction restitution
TRADEOFF ?=
STABILITY ?=
ABLATION ?=
files = --json $(REPORTS)/$(1).json --markdown $(REPORTS)/$(1).md
figures = --csv $(REPORTS)/$(1).csv --png $(REPORTS)/$(1).png

reports: reports-validate reports-tradeoff reports-stability \
	study reports-models reports-ablation reports-overhead \
	reports-learn-speed reports-data reports-data-full reports-pages readme

# A verdict of fail (exit code 1) is a result too.
reports-validate: $(VENV)/ready
	for scene in $(SCENES); do \
		$(BIN)/mbds-xsim validate $$scene --trajectories $(STARTS) --seed 1 \
			$(call files,$$scene) || [ $$? -eq 1 ] || exit; \
	done

# What is interrupted goes on where it stopped; so do the studies of stability.
reports-tradeoff: $(VENV)/ready
	for scene in $(SCENES); do \
		$(BIN)/mbds-xsim tradeoff $$scene $(TRADEOFF) \
			$(call files,tradeoff/$$scene) $(call figures,tradeoff/$$scene) || exit; \
	done

reports-stability: $(VENV)/ready
	for study in $(STUDIES); do \
		$(BIN)/mbds-xsim stability $$study $(STABILITY) $(call figures,stability/$$study) \
			--markdown $(REPORTS)/stability/$$study.md || exit; \
	done

reports-ablation: $(VENV)/ready
	$(BIN)/mbds-xsim ablate $(SCENES) $(ABLATION) --markdown $(REPORTS)/ablation.md

reports-overhead: $(VENV)/ready
	mkdir -p $(REPORTS)
	$(BIN)/python -m benchmarks.adapter_overhead > $(REPORTS)/adapter-overhead.md

# Models of other packages, which stay where they are installed. It goes on where it was.
WILD ?= out/wild
# Of the 213 that are imported; the others have more degrees of freedom and take hours.
WILD_VALIDATED ?= 155
$(WILD)/ready: pyproject.toml
	$(PYTHON) -m venv $(WILD)
	$(WILD)/bin/python -m pip install --quiet '.[wild]'
	touch $@

reports-models-in-the-wild: $(VENV)/ready $(WILD)/ready
	mkdir -p $(REPORTS)/wild
	$(BIN)/python -m benchmarks.models_in_the_wild $(WILD)/lib/python3.*/site-packages \
		$(REPORTS)/wild/models.json --validate $(WILD_VALIDATED)
	$(BIN)/python -m benchmarks.models_in_the_wild $(REPORTS)/wild/models.json \
		> $(REPORTS)/wild/models.md

reports-learn-speed: $(VENV)/ready
	$(BIN)/python -m benchmarks.learn_speed > $(REPORTS)/learn-speed.md

# Needs a GPU; no part of `make reports`.
reports-learn-speed-gpu: $(VENV)/ready
	$(BIN)/python -m benchmarks.learn_speed 3ladder --device cuda --tracks paper \
		> $(REPORTS)/learn-speed-gpu.md

# Trained models beside the engines, as far as there are any: those that were trained until level,
# or else the studies'. Their engines are those of the two reports above. A map is of models whose
# scene its study is made of.
MODELS ?= out/models
LITE ?= out/lite
TRAINING ?= native/*/mujoco-s0
MAPPED ?= pace/6pendulum links/6pendulum loops/3ladder throw/ballscroll
best = models=$(LITE); [ -d $$models/$$scene ] || models=$(MODELS)
named = --models "$$models/$$scene/$(TRAINING).pt"

reports-models: $(VENV)/ready
	$(BIN)/python -m benchmarks.energy_rollouts $(MODELS) $(STUDY) > $(REPORTS)/energy-rollouts.md
	for scene in $(SCENES); do $(best); \
		[ ! -d $$models/$$scene ] || [ $$scene = particlecar ] || \
			$(BIN)/mbds-xsim tradeoff $$scene $(named) \
			--onto $(REPORTS)/tradeoff/$$scene.json $(call files,models/$$scene) \
			$(call figures,models/$$scene) || exit; \
	done
	for pair in $(MAPPED); do \
		study=$${pair%/*}; scene=$${pair#*/}; $(best); \
		[ ! -d $$models/$$scene ] || $(BIN)/mbds-xsim stability $$study --settings matched \
			$(named) $(call figures,models/$$study) \
			--markdown $(REPORTS)/models/$$study.md || exit; \
	done

# Models under a change of engine, in some ten core-hours without `-factors` and `-worth`; a study has
# a target of its own, such as shift-3ladder, and whatever is there is gone on with. Data that keep
# no budget are what the field has: they are published as uncertified. Single-engine
# trainings alone have one seed; more: SEEDS=3.
STUDY ?= out/study
DRAWN ?= 1000
STEPS ?= 1000
WAYS = each,leave-one-out,all
# A change of speed, to hold one of engine against.
SPEEDS = mujoco-low,mujoco-medium,mujoco-high
SEEDS ?= 1
SHIFTED ?= 5pendulum 6pendulum 6pendulum-matched balldrop 3ladder simplecubli $(SCENES:%=%-factors) \
	2ladder-matched 3ladder-matched 2ladder-fine 2ladder-worth 3ladder-worth 5pendulum-worth 6pendulum-worth balldrop-worth ballscroll-worth
drawn = $(BIN)/mbds-xsim generate $(1) --settings $(2) --trajectories $(DRAWN) --out $(STUDY) \
	--engines $(ENGINES) \
	|| [ $$? -eq 1 ]
trained = $(BIN)/mbds-xsim train $(STUDY)/$(1) --on $(2) --steps $(STEPS) --out $(MODELS) \
	--png $(REPORTS)/shift/$(3)-curves.png
# The errors of every trajectory are too many to keep beside the pages: they go to out/.
told = --json $(REPORTS)/$(1).json.gz --markdown $(REPORTS)/$(1).md --png $(REPORTS)/$(1).png \
	--rollouts $(REPORTS)/$(1)-rollouts.png --csv out/$(1).csv
shifted = $(BIN)/mbds-xsim shift $(MODELS) $(STUDY) --scene $(2) $(call told,shift/$(1))
shift-targets = $(addprefix shift-,$(SHIFTED))
factor-targets = $(SCENES:%=shift-%-factors)
worth-targets = $(SCENES:%=shift-%-worth)
.PHONY: $(shift-targets) $(factor-targets) $(worth-targets)

# The whole study of learned models: some thirty core-hours from nothing.
study: reports-shift reports-lite reports-paper-tables

reports-shift: $(shift-targets)
	$(BIN)/python -m benchmarks.shift_summary $(REPORTS)/shift --png $(REPORTS)/shift/factors.png \
		> $(REPORTS)/shift/README.md

# Half the steps where a scene has many more particles and edges, but more where some models learn next
# to nothing in 500. Fewer trajectories where Exudyn takes long: some 10 s for one of 3ladder's, and
# it does the tested ones again on every domain.
shift-balldrop: STEPS = 500
shift-3ladder shift-simplecubli: STEPS = 1500
shift-5pendulum shift-3ladder shift-simplecubli: DRAWN = 300

shift-6pendulum shift-balldrop: shift-%: $(VENV)/ready
	$(call drawn,$*,native)
	$(call trained,$*/*-native.h5,$(WAYS) --models $(PUBLISHED),$*)
	$(if $(filter 6pendulum,$*),$(call trained,$*/*-native.h5,$(SPEEDS) --models $(PUBLISHED) --seeds $(SEEDS),$*-speed))
	$(call shifted,$*,$* --settings native)

# Of the published models HGNN and LGNN know no contact.
PUBLISHED = gns,sgnn
shift-5pendulum shift-6pendulum shift-6pendulum-matched reports-lite: PUBLISHED = gns,hgnn,lgnn,sgnn

shift-5pendulum shift-3ladder shift-simplecubli: shift-%: $(VENV)/ready
	$(call drawn,$*,native)
	$(call trained,$*/*-native.h5,each --models $(PUBLISHED) --seeds $(SEEDS),$*)
	$(call shifted,$*,$* --settings native)

# The same starts at either settings.
shift-6pendulum-matched: shift-%-matched: $(VENV)/ready
	$(call drawn,$*,native$(comma)matched)
	$(call trained,$*,each --models $(PUBLISHED) --seeds $(SEEDS),$*-matched)
	$(call shifted,$*-matched,$* --on each --seeds $(SEEDS))

# Which factor of a change of engine costs how much, by models of bodies, in two core-hours a scene: four engines
# as they are and matched; three of them at one step without damping; and alone another step, and no damping.
FACTORS ?= out/factors
FACTORED = equal coarse undamped
NETWORKS ?= gns+,hgnn+,lgnn+,sgnn+
# Where to train and test, as --device cuda --workers 15: so many processes share a GPU.
ON ?=
$(factor-targets) shift-2ladder-matched shift-2ladder-fine: STEPS = 200
$(worth-targets): STEPS = 100
shift-balldrop-factors shift-balldrop-worth: STEPS = 500
# hgnn+ and lgnn+ learn contact only once they know the energy, which 200 steps are too few for.
shift-ballscroll-factors shift-ballscroll-worth: STEPS = 400
# Where trainings of the same data end far apart, three seeds tell too little.
shift-ballscroll-factors shift-simplecubli-factors: SEEDED = --seeds 5
# The largest scene: tests of ten trajectories take 1.4 core-hours.
shift-3ladder-factors shift-3ladder-matched shift-3ladder-worth: STEPS = 150
shift-3ladder-factors shift-3ladder-matched shift-3ladder-worth: TESTED = --trajectories 10
$(factor-targets): shift-%-factors: $(VENV)/ready
	$(BIN)/mbds-xsim generate $* --trajectories 300 --out $(FACTORS) \
		--settings $(subst $() ,$(comma),$(FACTORED:%=benchmarks/factors/%.toml))$(comma)native$(comma)matched \
		--engines $(ENGINES) || [ $$? -eq 1 ]
	$(BIN)/mbds-xsim train $(FACTORS)/$* --track native+ --models $(NETWORKS) --steps $(STEPS) $(SEEDED) \
		--out $(FACTORS)/models --png $(REPORTS)/shift/$*-factors-curves.png $(ON)
	$(BIN)/mbds-xsim shift $(FACTORS)/models $(FACTORS) --scene $* $(TESTED) $(ON) $(call told,shift/$*-factors)

# Matched data of the ladders alone, in less time; and, in a folder of its own, 2ladder's at finer steps
# of the engines of first order.
FINE ?= out/fine
define alone
	$(BIN)/mbds-xsim generate $(1) --trajectories 300 --out $(2) --settings $(3) --engines $(ENGINES) \
		|| [ $$? -eq 1 ]
	$(BIN)/mbds-xsim train $(2)/$(1)/*-$(4).h5 --track native+ --models $(NETWORKS) --steps $(STEPS) \
		--out $(2)/models --png $(REPORTS)/shift/$(1)-$(4)-curves.png $(ON)
	$(BIN)/mbds-xsim shift $(2)/models $(2) --scene $(1) --settings $(4) $(TESTED) $(ON) \
		$(call told,shift/$(1)-$(4))
endef
alone-targets = shift-2ladder-matched shift-3ladder-matched shift-2ladder-fine
.PHONY: $(alone-targets)
shift-2ladder-matched shift-3ladder-matched: shift-%-matched: $(VENV)/ready
	$(call alone,$*,$(FACTORS),matched,matched)
shift-2ladder-fine: shift-%-fine: $(VENV)/ready
	$(call alone,$*,$(FINE),benchmarks/factors/fine.toml,fine)

# How good data must be: models that learned from a ladder of steps of engines, and of tolerances of the
# reference, by the error on the truth that what they learned from costs them. Half a core-hour a scene, more
# with more NETWORKS or STEPS.
WORTH ?= out/worth
$(worth-targets): shift-%-worth: $(VENV)/ready
	$(BIN)/mbds-xsim generate $* --trajectories 300 --out $(WORTH) \
		--settings $(subst $() ,$(comma),$(wildcard benchmarks/worth/*.toml)) || [ $$? -eq 1 ]
	$(BIN)/mbds-xsim train $(WORTH)/$* --track native+ --models $(NETWORKS) --steps $(STEPS) --out $(WORTH)/models
	$(BIN)/mbds-xsim shift $(WORTH)/models $(WORTH) --scene $* $(TESTED) $(call told,shift/$*-worth)

# All four models until more steps bring no more, on each engine's data: two and a half core-hours.
reports-lite: $(VENV)/ready
	$(call drawn,6pendulum,native)
	$(BIN)/mbds-xsim train $(STUDY)/6pendulum/*-native.h5 --on each --models $(PUBLISHED) --seeds 1 --out $(LITE) \
		--png $(REPORTS)/lite/6pendulum-curves.png
	$(BIN)/mbds-xsim shift $(LITE) $(STUDY) --scene 6pendulum --settings native \
		$(call told,lite/6pendulum)

# Every scene in every engine, and one set of the paper's size; what is there is gone on with.
ENGINES ?= mujoco,pybullet,dart,exudyn
DATA ?= out/data
EACH ?= 200
FULL ?= 15000
data = $(DATA)/$(1)/data
result = --json $(DATA)/$(1)/$(2).json
made = { $(BIN)/mbds-xsim generate $(2) --trajectories $(3) --out $(call data,$(1)) \
		$(call result,$(1),generate) || [ $$? -eq 1 ]; } && { $(BIN)/mbds-xsim verify \
		$(call data,$(1)) $(call result,$(1),verify) || [ $$? -eq 1 ]; }
said = mkdir -p $(DATA)/$(1) $(REPORTS) && printf '%s\n' \
	"mbds-xsim generate $(2) --trajectories $(3) --out data" "mbds-xsim verify data" \
	$(4) > $(DATA)/$(1)/commands
page = $(BIN)/python -m benchmarks.acceptance \
	$$(for name in each full; do [ ! -f $(DATA)/$$name/verify.json ] || echo $(DATA)/$$name; done) \
	> $(REPORTS)/data.md

reports-data: $(VENV)/ready
	$(call said,each,$(SCENES) --engines $(ENGINES),$(EACH),"mbds-xsim export data --out npz --format npz")
	$(call made,each,$(SCENES) --engines $(ENGINES),$(EACH))
	$(BIN)/mbds-xsim export $(call data,each) --out $(DATA)/each/npz --format npz \
		$(call result,each,export)
	$(page)

reports-data-full: $(VENV)/ready
	$(call said,full,6pendulum --engines mujoco,$(FULL))
	$(call made,full,6pendulum --engines mujoco,$(FULL))
	$(page)

reports-paper-tables: $(VENV)/ready
	$(BIN)/python -m benchmarks.paper_tables $(REPORTS)/shift $(REPORTS)/lite \
		> $(REPORTS)/paper-tables.md

# Every release of the engines on the index since one of each; what was measured is gone on with.
# A newest release that is worse (exit code 1) is a result too.
RELEASED ?= mujoco dart exudyn pybullet
reports-releases: $(VENV)/ready
	$(BIN)/mbds-xsim releases $(RELEASED) --json $(REPORTS)/releases.json.gz \
		--markdown $(REPORTS)/releases.md --png $(REPORTS)/releases.png \
		--html out/releases.html || [ $$? -eq 1 ]

# What is told of the reports: how near the validations come to the budgets, and the page of all.
reports-pages: $(VENV)/ready
	$(BIN)/python -m benchmarks.margins $(REPORTS) > $(REPORTS)/margins.md
	$(BIN)/python -m benchmarks.reports_page $(REPORTS) > $(REPORTS)/README.md

# Charts and maps anew, from the results that are stored beside them.
pictures: $(VENV)/ready
	$(BIN)/python -m benchmarks.pictures $(REPORTS)

# The table of README, from the trade-offs that are kept here, and its first picture, for which a
# Chromium must be there.
readme: $(VENV)/ready
	$(BIN)/python -m benchmarks.choose_table reports/tradeoff --into README.md
	$(BIN)/mbds-xsim validate 3ladder --json out/3ladder.json --html out/3ladder.html
	$(BIN)/python -m benchmarks.page_picture out/3ladder docs/images/validate-3ladder.png

clean:
	rm -rf $(VENV) build dist out *.egg-info .mypy_cache .ruff_cache .pytest_cache
