"""What a domain is made of beside its simulator: the parts that `marl_sched.domain.Domain` holds, as contracts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from gymnasium.spaces import Space

    from marl_sched.simulation import TurnSimulator


class Instance(Protocol):
    """What the rooms need to know of any domain's problem instance."""

    @property
    def identity(self) -> int:
        """A 64-bit hash of the content: the instance's name in counter-based randomness."""

    def as_json(self) -> dict[str, Any]:
        """Plain data from which the domain's `decode` makes the instance again."""

    def save(self, path: Path) -> None:
        """Write `as_json` to a file, whole or not at all."""


class CentralInterface(Protocol):
    """How the centralised Gymnasium environment speaks: one action decides for the whole team."""

    def action_space(self, simulator: Any) -> Space[Any]:
        """The space of a joint action."""

    def action_masks(self, simulator: Any) -> np.ndarray:
        """Which values each part of a joint action may take in row 0, bool, one part's values after the other's."""

    def play(self, simulator: Any, action: Any) -> tuple[float, dict[str, Any]]:
        """Take all turns that a joint action covers in row 0; the reward it brought and the step's infos."""


class LocalState(Protocol):
    """What one deployed agent knows: filled from the messages it may hear, read as an observation.

    Attributes:
        channels: the channels that the agent's view allows it to hear, sorted. It hears nothing else.
    """

    channels: tuple[str, ...]

    def hear(self, channel: str, payload: bytes) -> None:
        """Take in a channel's newest payload; InvalidMessageError, and no change, if it does not parse."""

    def observe(self) -> dict[str, np.ndarray]:
        """The agent's observation with B = 1, bit-equal to the simulator's when every channel is up to date."""

    def simulator(self) -> TurnSimulator | None:
        """What the agent was told as a simulator in which it is to decide, for schedulers that plan from a whole state.

        Row 0 holds what every channel says, with estimates in place of what nobody is told, and without the noise.
        It is for reading, and holds until the next call. None where the view hides something, or the domain has no
        such thing.
        """


class Telemetry(Protocol):
    """How a domain's true state is told over a wire, and what an agent makes of the part that it may hear.

    Both sides are pure: bytes out, bytes in, no transport. A channel is the part of a key after the run's name;
    its payload is a state, not a change, so the newest one is all that a late listener needs. All methods of
    the world's side speak of row 0 of the domain's own simulator.

    Attributes:
        time_unit: what a unit of simulated time is called in reports, such as "hour".
    """

    time_unit: str

    def frame(self, simulator: Any) -> bytes:
        """What every agent is told at the start: sizes, padding and view, nothing that a view hides."""

    def messages(self, simulator: Any, channels: Collection[str] | None = None) -> dict[str, bytes]:
        """Everything the world says at this decision epoch, channel -> payload; with `channels`, of those alone."""

    def turn_channels(self, simulator: Any, agent: int) -> Collection[str]:
        """The channels that a turn of this agent can change as long as no simulated time passes.

        Only they are encoded after such a turn. Agents that may act at one decision epoch are asked at once where none
        of them hears a channel that an earlier one's turn can change.
        """

    def series(self, simulator: Any) -> dict[str, list[float]]:
        """The objectives of every unit of time so far, name -> one value for each."""

    def local_state(self, frame: bytes, agent: int) -> LocalState:
        """An agent's empty local state; InvalidMessageError for a frame that does not parse or lacks the agent."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """What `marl-sched demo` shows of a domain: one deployed episode, then a comparison on other instances.

    Attributes:
        scale, objective, seed: of the deployed episode.
        policy: what decides unless the user says otherwise.
        local_rules: rules that play beside it under its view.
        central_rules: rules that play with the full view, the first and the last also in the picture of the episode.
        options: more options of the simulator, in both.
        comparison_seed, instances, episodes: of the comparison.
    """

    scale: str
    objective: str
    policy: str
    local_rules: tuple[str, ...]
    central_rules: tuple[str, ...]
    seed: int = 0
    comparison_seed: int = 90_001
    instances: int = 10
    episodes: int = 2
    options: Mapping[str, Any] = field(default_factory=dict)
