"""One statement of what is to be scheduled, which every command, environment, trainer and deployment takes.

    problem = Problem("airme", scale="small", count=20, seed=1, view={"kind": "local", "reach": 1})
    simulator = problem.simulator()                  # one env per instance
    Problem.from_json(problem.as_json()) == problem

Defaults are filled in here and nowhere else: what holds a problem needs no defaults of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_sched.domain import Domain, get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError, require, require_integer
from marl_sched.noise import SPLITS, Split, as_seed, episode_number, instance_generator

if TYPE_CHECKING:
    from marl_sched.simulation import TurnSimulator

SCHEMA = 1
COUNT, EPISODES = 100, 10  # what `marl-sched evaluate` plays unless told otherwise
MOST = 2**31 - 1
MOST_INSTANCES = 100_000  # drawn at once: seconds and some hundred MB of small fleets


class Problem:
    """What is to be scheduled and under which conditions; immutable.

    Attributes:
        domain: given as the domain or by its name.
        scale: of the generated instances; None where `instances` are given.
        count: number of instances.
        seed: of the generated instances and of the noise.
        split: "train", "validation" or "test": instances and noise of different splits never meet (marl_sched.noise).
        given: the instances, where they are not generated.
        files: the file of each given instance, None for one that was given as an object.
        pad: the scale whose largest instance sets the padded sizes; None: the largest of the instances does.
        episodes: episodes of each instance.
        horizon: length of an episode in the domain's `unit`.
        objective: what M1 is the mean of, and what the reward follows.
        view: what an acting agent sees, one of the domain's view objects.
        options: further options of the domain's simulator, by name.
    """

    domain: Domain
    scale: str | None
    count: int
    seed: int
    split: Split
    given: tuple[Any, ...] | None
    files: tuple[Path | None, ...] | None
    pad: str | None
    episodes: int
    horizon: int
    objective: str
    view: Any
    options: Mapping[str, Any]

    def __init__(
        self,
        domain: Domain | str,
        *,
        instances: Sequence[Any] | None = None,
        scale: str | None = None,
        count: int | None = None,
        seed: int = 0,
        split: Split = "test",
        pad: str | None = None,
        episodes: int = EPISODES,
        horizon: int | None = None,
        objective: str | None = None,
        view: Any = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Fill in the defaults and check every name.

        `instances` are objects or paths of files; without them `count` instances of `scale` (default: the domain's
        smallest) are drawn from `seed`, padded to `pad` (default: `scale`). Horizon, objective and view default to
        the domain's, the full view, the split to what `marl-sched evaluate` plays. Raises InvalidOptionError,
        UnknownNameError, or InvalidFileError for a file.
        """
        domain = domain if isinstance(domain, Domain) else get_domain(domain)
        given, files = _given(domain, instances)
        if given is not None and (scale is not None or count not in (None, len(given))):
            raise InvalidOptionError("scale, count: expected neither where instances are given; `pad` sets the padding")
        if given is None:
            scale = domain.require_scale(domain.default_scale if scale is None else scale)
            pad = scale if pad is None else pad
            count = require_integer("count", COUNT if count is None else count, 1, MOST_INSTANCES)
        values = {
            "domain": domain,
            "scale": scale,
            "count": len(given) if given is not None else count,
            "seed": as_seed(seed),
            "split": require("split", split, SPLITS),
            "given": given,
            "files": files,
            "pad": None if pad is None else domain.require_scale(pad),
            "episodes": require_integer("episodes", episodes, 1, MOST),
            "horizon": require_integer(
                "horizon", domain.default_horizon if horizon is None else horizon, 1, MOST, domain.unit
            ),
            "objective": domain.require_objective(domain.objectives[0] if objective is None else objective),
            "view": domain.make_view(view),
            "options": dict(options or {}),
        }
        domain.require_options(values["options"])
        vars(self).update(values)

    def __setattr__(self, name: str, value: Any) -> None:
        """A problem never changes: AttributeError."""
        raise AttributeError(f"{name}: a Problem never changes; but() makes another one")

    def __deepcopy__(self, memo: dict[int, Any]) -> Problem:
        """Itself: a problem never changes."""
        return self

    def but(self, **changes: Any) -> Problem:
        """The same problem with other arguments of the constructor; giving `instances` drops scale and count."""
        arguments: dict[str, Any] = {
            name: getattr(self, name)
            for name in ("domain", "seed", "split", "pad", "episodes", "horizon", "objective", "view", "options")
        }
        if self.given is not None:
            arguments["instances"] = self.given
        else:
            arguments |= {"scale": self.scale, "count": self.count}
            if self.pad == self.scale and "scale" in changes:
                del arguments["pad"]
        if "instances" in changes or ("scale" in changes and self.given is not None):
            for name in ("instances", "scale", "count"):
                arguments.pop(name, None)
        problem = Problem(**{**arguments, **changes})
        if problem.given is not None and "instances" not in changes:
            vars(problem)["files"] = self.files  # which are not read again
        return problem

    @cached_property
    def instances(self) -> tuple[Any, ...]:
        """The instances, given or drawn; drawn once."""
        if self.given is not None:
            return self.given
        return tuple(self.domain.instances(str(self.scale), self.count, self.seed, self.split))

    @property
    def unit(self) -> str:
        """What the horizon counts, in the plural: `hours`."""
        return self.domain.unit

    @property
    def length(self) -> str:
        """How long an episode is, in words: `720 hours`."""
        return f"{self.horizon} {self.unit}"

    def simulator(self, indices: Sequence[int] | None = None, **changes: Any) -> TurnSimulator:
        """A simulator at the start of its episodes, with one env for each instance.

        `indices` chooses instances, any of them repeatedly; `changes` are options of the simulator that go before
        the problem's. A simulator's own errors are passed on.
        """
        return self.simulator_of(self.instances if indices is None else [self.instances[i] for i in indices], **changes)

    def simulator_of(self, instances: Sequence[Any], **changes: Any) -> TurnSimulator:
        """The simulator of other instances under the same conditions; `changes` as for `simulator`."""
        arguments = {
            "view": self.view,
            "objective": self.objective,
            "horizon": self.horizon,
            "seed": self.seed,
            "pad": self.pad,
            **self.options,
        }
        return self.domain.make_simulator(instances, **{**arguments, **changes})

    def instance(self, index: int, seed: int | None = None) -> Any:
        """Instance `index`, drawn anew, of any number beyond `count` too; given ones are met in turn.

        `seed` draws that of another seed in the same split.
        """
        if self.given is not None:
            return self.given[index % len(self.given)]
        generator = instance_generator(self.seed if seed is None else seed, index, self.split)
        return self.domain.generate(str(self.scale), generator)

    def episode_numbers(self, episodes: Iterable[int]) -> list[int]:
        """The numbers by which the noise knows episodes 0, 1, ... of an instance in this split."""
        return [episode_number(int(episode), self.split) for episode in episodes]

    def as_json(self) -> dict[str, Any]:
        """Plain data, schema 1, from which `from_json` makes an equal problem.

        Instances from files are named by their path, others are written out.
        """
        data: dict[str, Any] = {"schema": SCHEMA, "env": self.domain.name}
        if self.given is None:
            data |= {"scale": self.scale, "count": self.count}
        else:
            pairs = zip(self.given, self.files or (), strict=True)
            data["instances"] = [str(file) if file is not None else one.as_json() for one, file in pairs]
        return data | {
            "pad": self.pad,
            "seed": self.seed,
            "split": self.split,
            "episodes": self.episodes,
            "horizon": self.horizon,
            "unit": self.unit,
            "objective": self.objective,
            "view": view_as_json(self.view),
            "options": dict(self.options),
        }

    @classmethod
    def from_json(cls, data: Any, where: str | Path = "problem") -> Problem:
        """The problem that `as_json` wrote; `where` is the file that errors name.

        Raises InvalidFileError for data of another form, and as the constructor.
        """
        if not isinstance(data, Mapping):
            raise InvalidFileError(where, "", "an object", data)
        if data.get("schema") != SCHEMA:
            raise InvalidFileError(where, "schema", str(SCHEMA), data.get("schema"))
        known = {"schema", "env", "instances", "scale", "count", "unit", *_ARGUMENTS}
        for name in data:
            if name not in known:
                raise InvalidFileError(where, str(name), f"one of {', '.join(sorted(known))}", name)
        for name in ("env", "unit"):
            if name not in data:
                raise InvalidFileError(where, name, "a name; the field is missing")
        domain = get_domain(data["env"])
        if data["unit"] != domain.unit:
            raise InvalidFileError(where, "unit", repr(domain.unit), data["unit"])
        arguments = {name: data[name] for name in ("scale", "count", *_ARGUMENTS) if name in data}
        if "instances" in data:
            arguments["instances"] = [
                Path(one) if isinstance(one, str) else domain.decode(one, f"{where}: instances[{i}]")
                for i, one in enumerate(data["instances"])
            ]
        return cls(domain, **arguments)

    def __eq__(self, other: object) -> bool:
        """Whether another problem states the same; instances are compared by their identity."""
        return isinstance(other, Problem) and self._key() == other._key()

    def __hash__(self) -> int:
        """Consistent with equality."""
        return hash((self.domain.name, self.scale, self.count, self.seed, self.horizon, self.objective))

    def _key(self) -> tuple[Any, ...]:
        values = {name: getattr(self, name) for name in Problem.__annotations__}
        values["domain"] = self.domain.name
        values["given"] = None if self.given is None else [one.identity for one in self.given]
        del values["files"]
        return tuple(values.items())

    def __repr__(self) -> str:
        """One line: `Problem(airme, 20 x small, seed 1, 10 episodes of 720 hours, profit, view local reach 1 ...)`."""
        source = f"{self.count} given" if self.given is not None else f"{self.count} x {self.scale}"
        options = "".join(f", {name} {value}" for name, value in self.options.items())
        split = "" if self.split == "test" else f" of {self.split}"
        return (
            f"Problem({self.domain.name}, {source}, seed {self.seed}{split}, {self.episodes} episodes of "
            f"{self.length}, {self.objective}, view {view_in_words(self.view)}{options})"
        )


_ARGUMENTS = ("pad", "seed", "split", "episodes", "horizon", "objective", "view", "options")


def _given(
    domain: Domain, instances: Sequence[Any] | None
) -> tuple[tuple[Any, ...] | None, tuple[Path | None, ...] | None]:
    """Given instances as objects, and the file of each."""
    if instances is None:
        return None, None
    if not instances:
        raise InvalidOptionError("instances: expected at least one, got none")
    files = tuple(Path(one) if isinstance(one, str | Path) else None for one in instances)
    return tuple(as_instance(domain, one) for one in instances), files


def as_instance(domain: Domain, instance: Any) -> Any:
    """An instance from a path to its file, or itself; InvalidOptionError for anything else."""
    if isinstance(instance, str | Path):
        return domain.load(Path(instance))
    if not isinstance(instance, domain.instance_type):
        expected = domain.instance_type.__name__
        raise InvalidOptionError(f"instance: expected {expected} or a file's path, got {type(instance).__name__}")
    return instance


def view_as_json(view: Any) -> dict[str, Any]:
    """`{"kind": "local", "reach": 1, ...}`; None is the full view."""
    return {"kind": "full"} if view is None else {"kind": view.kind, **asdict(view)}


def view_in_words(view: Any) -> str:
    """`local (reach 1, comm 1)`, from a view or from its JSON."""
    words = dict(view) if isinstance(view, Mapping) else view_as_json(view)
    kind = words.pop("kind")
    options = ", ".join(f"{name} {value}" for name, value in words.items())
    return f"{kind} ({options})" if options else str(kind)
