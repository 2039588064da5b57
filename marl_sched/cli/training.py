"""`marl-sched train`, `resume`, `export`, `export-onnx` and `curves`: policies learn and are measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.compilation import told_of_compilation
from marl_sched.errors import InvalidOptionError

EXPORT_SEED = 90_002  # of instances that neither training nor validation draws


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog="Example: marl-sched train view=local view.reach=1 algorithm=gae seed=1")(train)
    app.command(epilog="Example: marl-sched resume runs/mine")(resume)
    app.command(epilog="Example: marl-sched export runs/mine my-policy --out policies")(export)
    app.command("export-onnx", epilog="Example: marl-sched export-onnx policies/my-policy.json")(export_onnx)
    app.command(epilog="Example: marl-sched curves runs/gae-0 runs/gae-1 runs/ippo-0 --out curves.png")(curves)


def train(
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="Hydra overrides of configs/train.yaml.")
    ] = None,
) -> None:
    """Train a policy as configs/train.yaml says, with these overrides."""
    from marl_sched.train.run import train_from_overrides

    with told_of_compilation():
        typer.echo(train_from_overrides(overrides or []))


def resume(run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="The folder of a run.")]) -> None:
    """Go on with a training run exactly where its last checkpoint left it."""
    from marl_sched.train.run import resume as go_on

    with told_of_compilation():
        typer.echo(go_on(run_dir))


def export(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="The folder of a run.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="What the policy will be called.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for NAME.safetensors and NAME.json.")],
    instances: Annotated[int, typer.Option("--instances", min=1, help="Generated instances of each scale.")] = 100,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes of each instance.")] = 10,
    seed: options.Seed = EXPORT_SEED,
    scales: Annotated[
        str | None,
        typer.Option("--scales", metavar="NAMES", help="Separated by commas (default: all that the network can read)."),
    ] = None,
    length: Annotated[
        int | None,
        typer.Option("--length", min=1, help="Simulated time of an episode (default: the environment's)."),
    ] = None,
) -> None:
    """Measure a run's best policy on unseen instances of every scale; write its weights and its card."""
    from marl_sched.train.export import export_policy
    from marl_sched.train.malloc import keep_freed_memory

    if not name or Path(name).name != name or "." in name:
        raise InvalidOptionError(f"NAME: expected a name without dots and slashes, got {name!r}")
    options.check_folder(out)
    path = out / f"{name}.safetensors"
    keep_freed_memory()
    chosen = None if scales is None else [scale.strip() for scale in scales.split(",")]
    card = export_policy(run_dir, path, scales=chosen, instances=instances, episodes=episodes, seed=seed, length=length)
    for scale, measured in card.scores.items():
        found = measured["M1"] if isinstance(measured["M1"], dict) else {scale: measured["M1"]}
        means = ", ".join(f"{name} {mean:.4f}" if len(found) > 1 else f"{mean:.4f}" for name, mean in found.items())
        typer.echo(f"{scale}: M1 {means}")
    typer.echo(path)


def export_onnx(
    policy: Annotated[str, typer.Argument(metavar="POLICY", help="A shipped policy's name, or a checkpoint's path.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="What to write (default: NAME.onnx beside its card).")
    ] = None,
) -> None:
    """Write a policy for onnxruntime, by which agents decide without PyTorch (`deploy --runtime onnx`)."""
    from marl_sched.agents.policies.onnx_export import export_onnx as write
    from marl_sched.agents.registry import policy_path

    path = policy_path(policy)
    target = path.with_suffix(".onnx") if out is None else out
    options.check_output(target, "--out")
    typer.echo(write(path, target))


def curves(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN_DIR...", help="Folders of runs.")],
    out: Annotated[Path, typer.Option("--out", metavar="PNG", help="The picture; its numbers go beside it, as JSON.")],
    x: Annotated[str, typer.Option("--x", help="updates, time (simulated) or seconds.")] = "updates",
    measure: Annotated[
        str, typer.Option("--measure", help="reward_rate (M1 sampled in training) or validation.")
    ] = "reward_rate",
    smooth: Annotated[
        int | None,
        typer.Option("--smooth", min=1, help="Points a point is the mean of (default: reward_rate 10, validation 1)."),
    ] = None,
    by: Annotated[
        str, typer.Option("--by", metavar="KEY", help="The key of the configuration that groups runs.")
    ] = "algorithm.name",
) -> None:
    """Draw the learning curves of runs: a thin line for each, a thick one for the mean of a group."""
    from marl_sched.files import write_json
    from marl_sched.train.curves import learning_curves
    from marl_sched.train.evaluation.plots import curves_by_group, save

    if out.suffix == ".json":
        raise InvalidOptionError(f"--out: expected a picture such as curves.png, got {out}")
    options.check_output(out, "--out")
    numbers = learning_curves(runs, x=x, measure=measure, smooth=smooth, by=by)
    write_json(out.with_suffix(".json"), numbers)
    typer.echo(save(curves_by_group(numbers), out))
