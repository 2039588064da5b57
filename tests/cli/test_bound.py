"""`marl-sched bound` writes what no scheduler can pass."""

import json

import pytest


def test_bound_is_written_per_instance_and_its_mean_is_told(run, tmp_path):
    file = tmp_path / "bound.json"
    selectors = ("--instances", 2, "--hours", 24, "--objective", "availability")
    ended = run("bound", *selectors, "--price-vectors", 1, "--json", file)
    assert ended.code == 0
    result = json.loads(file.read_text())
    assert result["objective"] == "availability"
    assert (result["horizon"], result["unit"]) == (24, "hours")
    assert len(result["per_instance"]) == result["instances"] == 2
    assert result["M1"]["mean"] == pytest.approx(sum(result["per_instance"]) / 2)
    assert 0.3 < result["M1"]["mean"] < 1.0
    assert f"{result['M1']['mean']:.4f}" in ended.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--env", "murse"), "no bound is known for the environment 'murse'"),
        (("--objective", "speed"), "unknown objective"),
        (("--scale", "tiny"), "unknown scale"),
        (("--failure", "bathtub"), "failure: expected 'density' or 'hazard', got 'bathtub'"),
        (("--instances", 0), "--instances: expected at least 1, got 0"),
    ],
)
def test_what_cannot_be_bounded_is_refused_in_one_line(run, arguments, message):
    ended = run("bound", *arguments)
    assert ended.code == 2
    assert message in ended.err
    assert len(ended.err.strip().splitlines()) == 1
