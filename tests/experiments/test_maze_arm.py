"""What `reproduce maze-arm` counts; trainings and episodes are stood in for."""

import pytest

from palpate.experiments.contact import maze_arm

ENDS = {"arm": "goal", "tip": "violation", "still": "horizon"}


def test_episodes_of_all_policies_are_pooled_and_the_arms_held_against_the_bars(
    tmp_path, monkeypatch
):
    asked = []

    def tried(folder, who, episodes, seed):
        asked.append((folder.name, who, episodes, seed))
        ends = [ENDS[who]] * episodes
        if who == "arm" and folder.name.endswith("-32"):  # the second policy's first ten
            ends[:10] = ["violation"] * 10
        numbers = {"length": 100.0, "progress": 1.0, "force": 20.0}
        rest = {name: [value] * episodes for name, value in numbers.items()}
        return {"episodes": {"end": ends} | rest}

    monkeypatch.setattr(
        maze_arm, "train_on_tip", lambda experiment, seed: tmp_path / f"maze-{seed}"
    )
    monkeypatch.setattr(maze_arm, "evaluate_policy", tried)
    result = maze_arm.reproduce(tmp_path)
    figures = {figure.name: figure for figure in result.figures}
    assert figures["success_rate"].value == pytest.approx(490 / 500)
    assert figures["success_rate"].met
    assert figures["violation_rate"].value == pytest.approx(10 / 500)
    assert figures["violation_rate"].met  # 2 % is within the bar
    assert figures["violation_rate"].rival == "the tip 1"
    assert figures["detail.tip.success_rate"].value == 0
    assert figures["detail.still.success_rate"].met is None
    assert [folder for folder, who, *_ in asked if who == "arm"] == [
        f"maze-{seed}" for seed in (31, 32, 33)
    ]
    assert sum(episodes for _, who, episodes, _ in asked if who == "arm") == 500
    assert len({seed for _, who, _, seed in asked if who == "arm"}) == 3
    assert not {seed for *_, seed in asked} & set(range(100))  # no training's
