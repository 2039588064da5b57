"""A small list of tables, and cells whose numbers are made up."""

from copy import deepcopy

import pytest

from marl_sched.agents.policies.cards import write_card
from marl_sched.agents.registry import shipped_policies
from marl_sched.train.published.cells import Bound, Cell, Training
from marl_sched.train.published.entries import Entries
from marl_sched.train.published.plan import as_plan
from marl_sched.train.published.store import Cells

LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 0}
SIZE = {"instances": 2, "episodes": 2, "bound": {"price_vectors": 1, "evaluations": 1}}
TINY = {
    "env": "airme",
    "scales": ["small", "medium"],
    "objectives": ["profit", "revenue"],
    "full": SIZE,
    "quick": {**SIZE, "episodes": 1},
    "seed": 5,
    "horizon": 6,
    "rows": [
        {
            "label": "Corrective",
            "group": "published",
            "rule": "corrective-published",
            "published": {"profit": {"small": [0.5, 0.02, 0.0, 0.0]}},
        },
        {
            "label": "Condition-based",
            "group": "published",
            "rule": "condition",
            "published": {"profit": {"small": [0.4, 0.03, -20.0, 1.25]}},
        },
        {"label": "knowing", "group": "ours", "rule": "model-based", "objectives": ["profit"]},
        {
            "label": "net",
            "group": "ours",
            "policy": "policies/net-{objective}.safetensors",
            "command": "marl-sched train env.objective={objective}",
            "view": LOCAL,
            "options": {"scheme": "skip"},
            "scales": ["small"],
        },
    ],
    "decentralisation": {
        "objective": "profit",
        "scales": ["small"],
        "views": {"near": LOCAL, "late": {**LOCAL, "staleness": 3}, "everything": {"kind": "full"}},
        "lines": [
            {"label": "condition", "rule": "condition"},
            {"label": "learned", "policies": {"near": "policies/net-profit.safetensors"}},
        ],
    },
}


@pytest.fixture
def tiny():
    """The list as plain data, which a test may change."""
    return deepcopy(TINY)


@pytest.fixture
def plan(tiny):
    return as_plan(tiny, "tiny.yaml")


@pytest.fixture
def entries(plan, tmp_path):
    return Entries(plan, plan.full, tmp_path)


@pytest.fixture
def cells(tmp_path):
    return Cells(tmp_path / "cells" / "cells.jsonl")


@pytest.fixture
def trained(tmp_path):
    """The weights of the profit policy are there, with a card; they are none that could be loaded."""
    path = tmp_path / "policies" / "net-profit.safetensors"
    path.parent.mkdir()
    path.write_bytes(b"weights")
    write_card(path.with_suffix(".json"), shipped_policies()["airme-local-profit"])
    return path


SCORES = {"corrective-published": [0.4, 0.5], "condition": [0.5, 0.7], "model-based": [0.6, 0.6]}


@pytest.fixture
def write():
    """Write made-up cells of all jobs: scores as above, the policy's and the bound's as said below."""

    def write(entries, cells):
        for job in entries.all()[0]:
            inputs = job.inputs
            if isinstance(inputs, Bound):
                made = {"M1": [0.8, 0.9], "privileged_info": ["failure_model", "time_left"]}
            elif job.weights is not None:
                training = Training(command="marl-sched train view=local", seed=3, view=LOCAL, knowledge="a teacher")
                made = {"M1": [0.7, 0.8], "visible_share": 0.4, "training": training}
            else:
                known = ["failure_model"] if inputs.scheduler == "model-based" else []
                share = 1.0 if inputs.view["kind"] == "full" else 0.5
                made = {"M1": SCORES[inputs.scheduler], "visible_share": share, "privileged_info": known}
            for wanted in (inputs, *job.besides):
                cells.write(Cell(inputs=wanted, seconds=1.0, revision="", **made))

    return write
