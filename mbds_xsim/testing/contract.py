"""The suite every adapter must pass: the adapter declares, the suite measures.

Use it in a test file of your own, with a fixture that makes your adapter:

    from mbds_xsim.testing import AdapterContract

    class TestMyEngine(AdapterContract):
        @pytest.fixture
        def adapter(self):
            return MyEngine()
"""

from __future__ import annotations

import dataclasses
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from mbds_xsim.base.errors import InputError, UnknownName, Unsupported
from mbds_xsim.checks.integrity import start
from mbds_xsim.checks.kinematics import kinematics, velocity_lag
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter, Run, Settings
from mbds_xsim.simulate.claims import CONTACTS, Feature, Method, check_claims
from mbds_xsim.testing.case import Case
from mbds_xsim.testing.cases import CASES
from mbds_xsim.testing.contact_contract import CollisionContract, ContactContract
from mbds_xsim.testing.ladder import (
    EXACT,
    STEPS_PER_FRAME,
    answer_known_to,
    case_settings,
    measured_order,
    rolled,
)

_ORDER_MARGIN = 0.2
# An adaptive method's error is roughly proportional to its tolerance.
_PROPORTION = 0.8
# Least share of the first error that is left if steps do not matter, and of what is known of the
# answer that shows an order; least order that shows, and what it differs by from step to step.
_STUCK, _RESOLVED, _SHOWN = 0.5, 0.1, 0.5
_LATER = 10  # frame of a case's motion from which another trajectory starts
_NUMBER = re.compile(r"[-+]?\d+\.\d*(?:e[-+]?\d+)?")


class AdapterContract(ContactContract, CollisionContract):
    """Tests of an adapter, one for each way in which adapters go wrong."""

    @pytest.fixture
    def adapter(self) -> Adapter:
        """Make the adapter; every subclass overrides this."""
        raise NotImplementedError("give your suite a fixture `adapter` that makes your adapter")

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    def test_every_method_converges_to_the_answer_in_its_order(
        self, adapter: Adapter, case: Case
    ) -> None:
        """Each method meets the answer, or its declared order within 0.2, on each case it can run.

        The method's precision limits how exactly the answer can be met. The error of an adaptive
        method must follow its tolerance.
        """
        for method in adapter.methods.values():
            if adapter.refusals(case.scene, method.name):
                continue
            order, errors = measured_order(adapter, case, method.name)
            declared = _PROPORTION if method.adaptive else method.order_for(case.scene)
            met = errors[-1] < answer_known_to(case, method)
            stuck = errors[-1] > _STUCK * errors[0]
            assert met or order > declared - _ORDER_MARGIN, (
                f"{adapter.name} {method.name} on {case.name}: declared order {declared}, "
                f"measured {order:.2f} from errors {errors}"
                f"{', which shorter steps hardly reduce: another motion, or rounding' * stuck}"
            )
            assert errors[-1] < 0.2, f"{method.name} on {case.name}: converges to a wrong answer"

    def test_declared_orders_are_not_beaten_everywhere(self, adapter: Adapter) -> None:
        """Some telling case does not beat the declared order, and none misses it."""
        telling = [
            case for case in CASES if case.name in ("rod", "tumbling", "hinge", "parallelogram")
        ]
        for method in adapter.methods.values():
            if method.adaptive:
                continue
            able = [case for case in telling if not adapter.refusals(case.scene, method.name)]
            excess, resolved = list[float](), list[float]()
            for case in able:
                order, errors = measured_order(adapter, case, method.name)
                excess.append(order - method.order_for(case.scene))
                known = answer_known_to(case, method)
                # The answer is met in any case, and yet the order can be measured.
                if errors[-1] < known < errors[0] / _RESOLVED and _steady(errors):
                    resolved.append(excess[-1])
            assert excess, f"{method.name} can run none of the telling cases"
            assert min(excess) < 0.8, f"{method.name} is of higher order than declared: {excess}"
            short = min(resolved, default=0.0) < -0.8
            assert not short, f"{method.name} is of lower order than declared: {resolved}"

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    def test_velocities_are_those_of_the_motion(self, adapter: Adapter, case: Case) -> None:
        """Velocities fit the positions in every frame, at the time that the method declares."""
        for method in _able(adapter, case.scene):
            batch, motion = rolled(adapter, case, method.name, _COARSE)
            record = Record(case.scene, batch, motion, method, case.scene.clock.frame / _COARSE)
            faults = [
                finding.line(0)
                for finding in (velocity_lag.finding(record), kinematics.finding(record))
                if not finding.passed.all()
            ]
            assert not faults, f"{adapter.name} {method.name} on {case.name}: {'; '.join(faults)}"

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    def test_the_native_model_reads_back_as_the_scene(self, adapter: Adapter, case: Case) -> None:
        """Mass, inertia, poses, velocities, gravity, step, axes are right; no damping is added."""
        for method in _able(adapter, case.scene):
            batch, settings = draw_batch(case.scene, [0]), case_settings(adapter, case, method, 4)
            with adapter.open(case.scene, settings) as run:
                native = run.readback(batch)

            mechanism = Mechanism.of(case.scene)
            assert readback.compare(mechanism, batch, settings, native, method) == []

    def test_frame_zero_is_the_start(self, adapter: Adapter) -> None:
        """Frame 0 holds the start, in the right shapes, units and order of bodies."""
        for case in _able_cases(adapter):
            method = _first(adapter, case)
            batch, trajectory = rolled(adapter, case, method.name, _COARSE)

            frames = case.scene.clock.steps + 1
            assert trajectory.position.shape == (1, frames, len(case.scene.bodies), 3)
            finding = start.finding(Record(case.scene, batch, trajectory, method))
            assert finding.passed.all(), f"{adapter.name} on {case.name}: {finding.line(0)}"

    def test_time_is_that_of_the_frames(self, adapter: Adapter) -> None:
        """Frame k is at time k · frame."""
        for case in _able_cases(adapter)[:1]:
            _, trajectory = rolled(adapter, case, _first(adapter, case).name, _COARSE)

            np.testing.assert_allclose(trajectory.time, np.arange(51) * 0.02, rtol=1e-12)

    def test_quaternions_are_unit_and_finite(self, adapter: Adapter) -> None:
        """The tumbling case catches a wrong convention (not wxyz); this test catches drift."""
        for case in _able_cases(adapter):
            _, trajectory = rolled(adapter, case, _first(adapter, case).name, _FINER)

            np.testing.assert_allclose(
                np.linalg.norm(trajectory.orientation, axis=-1), 1.0, atol=1e-9
            )

    def test_same_batch_same_bits(self, adapter: Adapter) -> None:
        """A batch repeats to the bit in the same run, and in a run loaded afresh."""
        case = _able_cases(adapter)[-1]
        batch = draw_batch(case.scene, [0, 1])
        with _opened(adapter, case, 4) as run:
            first, second = run.rollout(batch), run.rollout(batch)
        with _opened(adapter, case, 4) as run:
            third = run.rollout(batch)

        for other in (second, third):
            np.testing.assert_array_equal(first.position, other.position)
            np.testing.assert_array_equal(first.angular_velocity, other.angular_velocity)

    def test_trajectories_of_a_batch_do_not_touch_each_other(self, adapter: Adapter) -> None:
        """Each of two trajectories is the same as alone, and results share no memory."""
        case = _able_cases(adapter)[-1]
        batch = _two_starts(adapter, case)
        with _opened(adapter, case, 4) as run:
            both, again = run.rollout(batch), run.rollout(batch)
            alone = [run.rollout(batch[[row]]) for row in range(2)]

        assert not np.shares_memory(both.position, again.position), "a result is overwritten later"
        for row in range(2):
            np.testing.assert_array_equal(
                both.position[row], alone[row].position[0], f"trajectory {row}, beside the other"
            )

    def test_a_shorter_batch_ends_earlier(self, adapter: Adapter) -> None:
        """A batch decides how many frames are simulated, not the scene's clock."""
        case = _able_cases(adapter)[0]
        batch = draw_batch(case.scene, [0])
        with _opened(adapter, case, 4) as run:
            whole, part = run.rollout(batch), run.rollout(batch.truncated(5))

        np.testing.assert_allclose(part.position, whole.position[:, :6], rtol=0, atol=EXACT)

    def test_two_open_runs_do_not_touch_each_other(self, adapter: Adapter) -> None:
        """Interleaved runs of two scenes give what each gives alone."""
        first, second = _able_cases(adapter)[0], _able_cases(adapter)[-1]
        with _opened(adapter, second, 4) as a:
            alone = a.rollout(draw_batch(second.scene, [0]))
            with _opened(adapter, first, 4) as b:
                b.rollout(draw_batch(first.scene, [0]))
                beside = a.rollout(draw_batch(second.scene, [0]))

        np.testing.assert_array_equal(alone.position, beside.position)

    def test_what_cannot_be_done_is_refused_with_the_reason(self, adapter: Adapter) -> None:
        """Unsupported scenes are refused before the engine sees them."""
        refused = 0
        for case in CASES:
            for method in adapter.methods.values():
                refusals = adapter.refusals(case.scene, method.name)
                if not refusals:
                    continue
                refused += 1
                with pytest.raises(Unsupported) as caught:
                    adapter.open(case.scene, Settings(method.name, 0.02))
                assert next(iter(refusals.values())) in str(caught.value)
        for name, refuses in _refusing(adapter):
            for feature, reason in refuses.items():
                assert len(reason) > 10, f"{name} refuses {feature.value} without a reason"
            on_ground = set(refuses) <= set(CONTACTS)
            assert refused or on_ground, f"no case of the ladder needs what {name} refuses"

    def test_wrong_settings_are_refused_in_one_line(self, adapter: Adapter) -> None:
        """Refused are an unknown method or option, and a step that does not divide the frame."""
        case = _able_cases(adapter)[0]
        method = _first(adapter, case).name
        with pytest.raises(UnknownName, match="no-such-method"):
            adapter.open(case.scene, Settings("no-such-method", 0.02))
        with pytest.raises(UnknownName, match="no_such_option"):
            adapter.open(case.scene, Settings(method, 0.02, {"no_such_option": 1}))
        for step in (0.003, 0.04, 0.0, -0.02, float("nan")):
            with pytest.raises(InputError, match="divided by a whole number"):
                adapter.open(case.scene, Settings(method, step))

    def test_presets_are_for_a_method_that_can_run_the_scene(self, adapter: Adapter) -> None:
        """Both profiles fit every case that the engine supports at all."""
        for case in _able_cases(adapter):
            for profile in ("native", "matched"):
                adapter.check(case.scene, adapter.settings(case.scene, profile))

    def test_a_sceptic_can_run_what_the_engine_was_given(
        self, adapter: Adapter, tmp_path: Path
    ) -> None:
        """A native script ends where the engine does, springs included; other formats are XML."""
        able = _able_cases(adapter)
        case = next((case for case in able if case.scene.springs), able[0])
        batch = draw_batch(case.scene, [0], noise=False, inputs=False)
        with _opened(adapter, case, 2) as run:
            text, motion = run.native(batch), run.rollout(batch)
        if text.lstrip().startswith("<"):
            ElementTree.fromstring(text)
            return
        (tmp_path / "script.py").write_text(text, "utf-8")
        script = [sys.executable, "script.py"]
        process = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, timeout=60)

        assert process.returncode == 0, process.stderr
        numbers = np.array([float(number) for number in _NUMBER.findall(process.stdout)])
        for place in motion.position[0, -1].ravel():
            assert np.abs(numbers - place).min(initial=np.inf) < EXACT, f"{place} is not in the end"

    def test_the_version_has_a_number(self, adapter: Adapter) -> None:
        """Results name the engine's version, so it must hold a number."""
        assert any(character.isdigit() for character in adapter.version())

    def test_it_pickles(self, adapter: Adapter) -> None:
        """Adapters travel to worker processes."""
        assert pickle.loads(pickle.dumps(adapter)).name == adapter.name

    def test_closing_twice_and_many_opens(self, adapter: Adapter) -> None:
        """Closing a run releases the engine's memory; closing it twice does no harm."""
        case = _able_cases(adapter)[0]
        for _ in range(40):
            run = _opened(adapter, case, 1)
            run.close()
            run.close()

    def test_claims_are_complete(self, adapter: Adapter) -> None:
        """Names, features and methods are of the known kinds."""
        check_claims(adapter.methods, adapter.options, adapter.sweeps, adapter.cut)
        for name, refuses in _refusing(adapter):
            unknown = [feature for feature in refuses if not isinstance(feature, Feature)]
            assert not unknown, f"{name} refuses what is no feature: {unknown}"
        assert adapter.coordinates in ("reduced", "maximal"), adapter.coordinates


_COARSE, _FINER, _ = STEPS_PER_FRAME
"""Steps per frame of motions that are cached already, because orders are measured with them."""


def _opened(adapter: Adapter, case: Case, steps_per_frame: int) -> Run:
    settings = case_settings(adapter, case, _first(adapter, case), steps_per_frame)
    return adapter.open(case.scene, settings)


def _steady(errors: list[float]) -> bool:
    """Return whether errors fall alike with each halving of the step: rounding does not."""
    halvings = -np.diff(np.log2(np.maximum(errors, 1e-300)))
    return bool(np.ptp(halvings) < _SHOWN < halvings.min())


def _refusing(adapter: Adapter) -> Iterator[tuple[str, Mapping[Feature, str]]]:
    """Yield the refusals of the engine, and of each of its methods."""
    yield adapter.name, adapter.limits
    for method in adapter.methods.values():
        yield f"{adapter.name} {method.name}", method.refuses


def _able(adapter: Adapter, scene: Scene) -> list[Method]:
    return [m for m in adapter.methods.values() if not adapter.refusals(scene, m.name)]


def _able_cases(adapter: Adapter) -> list[Case]:
    cases = [case for case in CASES if _able(adapter, case.scene)]
    assert len(cases) >= 2, "the suite compares two scenes: an engine must run two of the ladder"
    return cases


def _two_starts(adapter: Adapter, case: Case) -> Batch:
    """Start a case as it is, and with half its inputs from a later frame of its motion."""
    first, motion = rolled(adapter, case, _first(adapter, case).name, _COARSE)
    starts = {
        key: np.stack([getattr(first, key)[0], getattr(motion, key)[0, _LATER]]) for key in STATES
    }
    both = draw_batch(case.scene, [0, 1])
    inputs = {key: getattr(both, key).copy() for key in ("force", "torque")}
    for values in inputs.values():
        values[1] *= 0.5
    return dataclasses.replace(both, **starts, **inputs)


def _first(adapter: Adapter, case: Case) -> Method:
    return _able(adapter, case.scene)[0]
