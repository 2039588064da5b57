"""`marl-sched list` and `doctor`: what there is, and what is missing."""

from __future__ import annotations

import os
import platform
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from marl_sched.domain import Domain

# What `doctor` looks for: distribution -> the extra that brings it, "" for what every installation has.
DISTRIBUTIONS = {
    "numpy": "",
    "scipy": "",
    "numba": "",
    "gymnasium": "",
    "pettingzoo": "",
    "msgspec": "",
    "typer": "",
    "rich": "",
    "torch": "train",
    "torchrl": "train",
    "tensordict": "train",
    "safetensors": "train",
    "hydra-core": "train",
    "tensorboard": "train",
    "eclipse-zenoh": "deploy",
    "ortools": "solvers",
    "matplotlib": "plots",
}


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command("list", epilog="Example: marl-sched list")(list_all)
    app.command(epilog="Example: marl-sched doctor")(doctor)


def list_all() -> None:
    """Show environments with their scales, objectives and views, schedulers, and shipped policies."""
    from marl_sched.agents.registry import rules, shipped_policies
    from marl_sched.domain import domain_names, get_domain

    for name in domain_names():
        domain = get_domain(name)
        typer.echo(f"{name}: {domain.title}")
        typer.echo(f"  scales       {', '.join(domain.scales)}")
        typer.echo(f"  objectives   {', '.join(domain.objectives)}")
        typer.echo(f"  views        {', '.join(_view(*item) for item in domain.views.items())}")
        typer.echo(f"  options      {', '.join([f'{domain.unit}={domain.default_horizon}', *_options(domain)])}")
        typer.echo(f"  schedulers   {', '.join(rules(name)) or 'none'}")
        policies = {policy: card for policy, card in shipped_policies().items() if card.domain == name}
        typer.echo(f"  policies     {', '.join(policies) or 'none'}")
        for policy, card in policies.items():
            typer.echo(f"    {policy}: for {card.objective}, view {_card_view(card.view)}, {_card_scores(card.scores)}")


def doctor() -> None:
    """Show versions, threads, GPU and Zenoh, and for what is missing how to get it."""
    import marl_sched

    typer.echo(f"marl-sched     {marl_sched.__version__}")
    typer.echo(f"python         {platform.python_version()} on {platform.system()} {platform.machine()}")
    typer.echo(f"cpu            {os.cpu_count()} cores, OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'not set')}")
    missing = set()
    for distribution, extra in DISTRIBUTIONS.items():
        try:
            typer.echo(f"{distribution:<14} {version(distribution)}")
        except PackageNotFoundError:
            missing.add(extra)
            get = f"pip install 'marl-sched[{extra}]'" if extra else "pip install marl-sched"
            typer.echo(f"{distribution:<14} missing; {get}")
    _say_torch()
    _say_zenoh()
    typer.echo("everything is there" if not missing else f"missing extras: {', '.join(sorted(missing))}")


def _say_torch() -> None:
    try:
        import torch
    except ModuleNotFoundError:
        return  # listed above as missing
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    typer.echo(f"torch threads  {torch.get_num_threads()}")
    typer.echo(f"gpu            {', '.join(gpus) or 'none'}")


def _say_zenoh() -> None:
    """Open a session that listens on a free port of this machine, as a world does."""
    try:
        import zenoh
    except ModuleNotFoundError:
        return  # listed above as missing
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    try:
        with zenoh.open(config):
            typer.echo("zenoh          a session opens and listens on 127.0.0.1")
    except zenoh.ZError as error:
        typer.echo(f"zenoh          no session can be opened: {error}")


def _options(domain: Domain) -> list[str]:
    """The simulator's options with their defaults, as they are typed."""
    return [f"{name.replace('_', '-')}={default}" for name, default in domain.simulator_options.items()]


def _view(name: str, kind: type) -> str:
    options = ", ".join(f"{field.name}={field.default}" for field in fields(kind))
    return f"{name}({options})" if options else name


def _card_view(view: dict[str, Any]) -> str:
    options = " ".join(f"{name} {value}" for name, value in view.items() if name != "kind")
    return f"{view.get('kind', 'unknown')} {options}".strip()


def _card_scores(scores: dict[str, Any]) -> str:
    """M1 by scale; of a validation on several scales each of them."""
    known = []
    for name, score in scores.items():
        m1 = score.get("M1") if isinstance(score, dict) else None
        for part, value in m1.items() if isinstance(m1, dict) else [("", m1)]:
            known += [] if value is None else [f"{name} {part}".strip() + f" {value:.4f}"]
    return "M1 " + ", ".join(known) if known else "no measured scores"
