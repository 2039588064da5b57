"""Imports run one way, only training and learned policies need torch, and the wheel leaves no package out."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("envs", "agents", "train", "comms", "configs")

# Room -> rooms that it may import when it is imported. `core` is marl_sched/ itself.
ALLOWED = {
    "core": {"core"},
    "configs": {"core", "configs"},
    "envs": {"core", "envs"},
    "agents": {"core", "envs", "agents"},
    "train": {"core", "envs", "agents", "train", "configs"},
    "comms": {"core", "envs", "agents", "comms", "configs"},
    "cli": {"core", "envs", "agents", "train", "comms", "configs", "cli"},
}
# Public modules that are a domain's environment API, and therefore stand on the room that holds it.
FRONT_DOORS = {f"marl_sched.{page}": "envs" for page in ("airme_v0", "murse_v0", "ward_v0")}

# What may need torch: the TorchRL environment, learned policies and training. Comparing rules does not.
NEEDS_TORCH = (
    "marl_sched.envs.api.torchrl",
    "marl_sched.agents.networks",
    "marl_sched.agents.murse.networks.",
    "marl_sched.agents.murse.step_learning",
    "marl_sched.agents.murse.step_planner",
    "marl_sched.agents.policies.checkpoint",
    "marl_sched.agents.policies.network_policy",
    "marl_sched.agents.policies.onnx_",
    "marl_sched.train.",
)
DOES_NOT = (
    "marl_sched.train.evaluation.evaluate",
    "marl_sched.train.evaluation.compare",
    "marl_sched.train.evaluation.plots",
)

BLOCKER = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"torch", "torchrl", "tensordict"}:
            raise ModuleNotFoundError(f"{name} is blocked", name=name)

sys.meta_path.insert(0, Blocked())
"""


def modules() -> dict[str, Path]:
    """Every module of the package by its installed name."""
    found = {}
    for folder in ("marl_sched", *ROOMS):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts if folder == "marl_sched" else ("marl_sched", *parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def room_of(module: str) -> str:
    parts = module.split(".")
    if module in FRONT_DOORS:
        return FRONT_DOORS[module]
    return parts[1] if len(parts) > 1 and parts[1] in (*ROOMS, "cli") else "core"


def import_time_statements(tree: ast.AST) -> Iterator[ast.stmt]:
    """Statements that run when the module is imported: no function bodies, nothing for type checkers alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for other in node.orelse:
                yield from import_time_statements(other)
            continue
        if isinstance(node, ast.stmt):
            yield node
        yield from import_time_statements(node)


def imported_at_once(path: Path) -> set[str]:
    """Modules of the package that importing the file at `path` imports."""
    names = set()
    for statement in import_time_statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(statement, ast.Import):
            names.update(alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            assert statement.level == 0, f"{path}:{statement.lineno}: a relative import"
            inner = {f"{statement.module}.{alias.name}" for alias in statement.names}
            submodules = inner & MODULES.keys()
            names.update(submodules or {str(statement.module)})
    return {name for name in names if name.split(".")[0] == "marl_sched"}


def run(code: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a fresh interpreter that sees the installed package alone: -P keeps the working folder out."""
    return subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=240, check=False)


@pytest.mark.parametrize("module", MODULES)
def test_imports_run_one_way(module):
    room = room_of(module)
    wrong = {name for name in imported_at_once(MODULES[module]) if room_of(name) not in ALLOWED[room]}
    assert not wrong, f"{module} ({room}) imports {sorted(wrong)}"


def test_a_wrong_import_would_be_seen(tmp_path):
    path = tmp_path / "core.py"
    path.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    import marl_sched.train\n"
        "def later():\n    import marl_sched.comms\n"
        "try:\n    from marl_sched import errors\nfinally:\n    import marl_sched.envs\n"
        "from marl_sched.agents import base\n"
    )
    assert imported_at_once(path) == {"marl_sched.errors", "marl_sched.envs", "marl_sched.agents.base"}


def test_importing_the_package_loads_neither_kernels_nor_torch():
    heavy = {"numba", "scipy", "pettingzoo", "torch", "gymnasium"}
    done = run(f"import sys, marl_sched; print(sorted({heavy} & sys.modules.keys()))")
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_everything_but_learning_imports_without_torch():
    torchless = [name for name in MODULES if not name.startswith(NEEDS_TORCH) or name in DOES_NOT]
    torchless = [name for name in torchless if not name.endswith(".__main__")]  # importing these runs them
    assert {"marl_sched.envs", "marl_sched.agents.base", "marl_sched.comms"} <= set(torchless)
    done = run(BLOCKER + f"import importlib\nfor name in {torchless!r}:\n    importlib.import_module(name)")
    assert done.returncode == 0, done.stderr[-2000:]


def test_environment_runs_without_any_optional_dependency():
    optional = {"torch", "torchrl", "tensordict", "safetensors", "hydra", "omegaconf", "tensorboard"}
    optional |= {"zenoh", "ortools", "matplotlib"}
    code = """
from marl_sched import airme_v0
env = airme_v0.env(horizon=3)
env.reset(seed=1)
for agent in env.agent_iter():
    observation, reward, termination, truncation, info = env.last()
    env.step(None if termination or truncation else 0)
print(env.agents)
"""
    done = run(BLOCKER.replace('{"torch", "torchrl", "tensordict"}', repr(optional)) + code)
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_torch_is_blocked_where_it_is_said_to_be():
    done = run(BLOCKER + "import torch")
    assert done.returncode == 1
    assert "torch is blocked" in done.stderr


def test_public_names_are_offered_and_others_refused():
    import marl_sched

    assert set(marl_sched.__all__) <= set(dir(marl_sched))
    with pytest.raises(AttributeError, match="no airme_v9; the versions of this environment are airme_v0"):
        _ = marl_sched.airme_v9


def test_no_room_lands_at_the_top_of_site_packages():
    done = run(f"import importlib.util; print([room for room in {ROOMS!r} if importlib.util.find_spec(room)])")
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("folder", sorted({path.parent.relative_to(ROOT).as_posix() for path in MODULES.values()}))
def test_every_folder_with_code_is_a_package(folder):
    assert (ROOT / folder / "__init__.py").exists(), "find_packages would leave it out of the wheel"
