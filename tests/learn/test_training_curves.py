"""The look of learning curves."""

from mbds_xsim.learn.curves import looks


def test_an_engine_looks_the_same_whichever_others_there_are() -> None:
    alone = looks(["mujoco"])
    beside = looks(["all", "dart", "mujoco", "not-dart", "not-mujoco"])
    assert alone["mujoco"] == beside["mujoco"]
    assert beside["mujoco"][0] == beside["not-mujoco"][0] != beside["dart"][0]


def test_trainings_are_told_apart() -> None:
    engines = ("dart", "exudyn", "mujoco", "pybullet")
    ways = [word.format(e) for word in ("{}", "not-{}", "{}-low", "{}-high") for e in engines]
    found = looks([*ways, "all"])
    assert len(set(found.values())) == len(ways) + 1
