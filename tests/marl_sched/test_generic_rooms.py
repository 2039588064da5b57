"""Rooms that serve every domain name none: only their registration does, and examples in docstrings."""

import ast
import re
from io import StringIO
from pathlib import Path
from token import COMMENT
from tokenize import generate_tokens

import pytest

from marl_sched.envs import DOMAINS

ROOT = Path(__file__).resolve().parents[2]
GENERIC = ("marl_sched", "envs/api", "train", "comms", "agents/policies", "agents/networks")
# Public modules of one domain, and the files that register it.
REGISTRATION = {"marl_sched/__init__.py", "marl_sched/gymnasium_ids.py", "marl_sched/pettingzoo_ids.py"}
FILES = sorted(
    path
    for path in [*(ROOT / "agents").glob("*.py"), *(path for room in GENERIC for path in (ROOT / room).rglob("*.py"))]
    if str(path.relative_to(ROOT)) not in REGISTRATION
    and not path.name.startswith(tuple(f"{name}_v" for name in DOMAINS))
)
# A name counts as a word of its own, of snake_case or CamelCase: `ward` is in `WardSimulator` and not in `forward`.
NAMES = re.compile(
    "|".join(f"(?<![A-Za-z])(?i:{name})(?![a-z])|(?<=[a-z]){name.capitalize()}(?![a-z])" for name in DOMAINS)
)


def named(source: str) -> list[str]:
    """Words of a module's code and comments that name a domain; docstrings are none."""
    tree = ast.parse(source)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    words = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            words.append(node.value)
        words += [getattr(node, field) for field in ("id", "attr", "name", "module", "arg") if hasattr(node, field)]
    words += [token.string for token in generate_tokens(StringIO(source).readline) if token.type == COMMENT]
    return [word for word in words if isinstance(word, str) and NAMES.search(word)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_domain_is_named_in_code_that_serves_all(path):
    assert named(path.read_text(encoding="utf-8")) == []


def test_a_name_in_code_would_be_seen_and_one_in_a_docstring_not():
    first = next(iter(DOMAINS))
    assert named(f'"""Like {first}."""\nenv = \'{first}\'\n') == [first]
    assert named(f"fleet = 3  # of {first}\n") == [f"# of {first}"]
    assert named(f"import marl_sched.envs.{first}.views\n") == [f"marl_sched.envs.{first}.views"]


@pytest.mark.parametrize("name", DOMAINS)
def test_a_name_is_seen_as_a_word_of_an_identifier_and_not_within_one(name):
    title = name.capitalize()
    for code in (name, f"{name}_v0", f"{title}Simulator", f"My{title}", f"make_{name}", name.upper()):
        assert named(f"{code} = 1\n") == [code]
    assert named(f"for{name} = re{name}ing = 1\n") == []
