"""What can happen to the world or to an agent, and what they want done about it: plain values, compared in tests.

An event goes into `handle(event, now)`; a list of effects comes out. The driver owns the clock and the transport: it
turns what arrives into events and carries effects out. Times are seconds of whatever clock the driver has.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum

from marl_sched.comms.protocol.messages import Message, Operator, Team, Turn, Work


class ExitCode(IntEnum):
    """How a world or a deployment ends; 128 + n after signal n."""

    COMPLETE = 0
    DEFECT = 1  # an error of this package; it keeps its traceback
    USER_ERROR = 2  # what was asked for is impossible, or could not start
    AGENTS_LOST = 3  # the run came to its end, and at least one agent was lost on the way
    QUORUM_LOST = 4  # time stood still for longer than the limit


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    NOT_GATHERED = "not_gathered"
    QUORUM_LOST = "quorum_lost"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


class Outcome(StrEnum):
    """How a turn went; in all but the first the agent idles for this decision epoch."""

    DECIDED = "decided"
    CONFLICT = "conflict"  # impossible in truth
    ILLEGAL = "illegal"  # impossible in the agent's view
    LATE = "late"  # no answer in time
    ABSENT = "absent"  # nobody there to ask
    LAPSED = "lapsed"  # another choice of the same epoch ended it before


# ---- events


@dataclass(frozen=True, slots=True)
class Received:
    """A message came by a key (without the run's prefix)."""

    key: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class TokenAppeared:
    """A liveliness token stands."""

    key: str


@dataclass(frozen=True, slots=True)
class TokenVanished:
    """A liveliness token has gone."""

    key: str


@dataclass(frozen=True, slots=True)
class Queried:
    """Somebody asks by a key; answered with Reply(query, ...)."""

    key: str
    payload: bytes
    query: int


@dataclass(frozen=True, slots=True)
class Answered:
    """The answer to Ask(question, ...), or None if there was none in time."""

    question: int
    payload: bytes | None


@dataclass(frozen=True, slots=True)
class Wake:
    """Time has passed."""


@dataclass(frozen=True, slots=True)
class Interrupted:
    """The process was told to end, by signal `number`."""

    number: int


@dataclass(frozen=True, slots=True)
class Request:
    """The plant asks an agent to decide."""

    agent: int
    noise: float


@dataclass(frozen=True, slots=True)
class PlantAdvanced:
    """Where the plant stands now: who is to decide, and every channel that changed since the last time.

    `progress` counts units of the run's horizon, such as rounds; the protocol does not look at it.
    """

    tick: int
    requests: tuple[Request, ...]
    changed: dict[str, bytes]
    over: bool = False
    progress: int = 0


@dataclass(frozen=True, slots=True)
class Ordered:
    """The plant's answer to Order(query, order): why it does not carry it out, None if it does."""

    query: int
    request: str
    reason: str | None


@dataclass(frozen=True, slots=True)
class Chosen:
    """The policy's action for turn `sequence`; `remembered`: see messages.Decision."""

    sequence: int
    action: int
    remembered: int | None = None


@dataclass(frozen=True, slots=True)
class Reopened:
    """The session was closed and stands again; nothing is subscribed or announced."""


Event = (
    Received
    | TokenAppeared
    | TokenVanished
    | Queried
    | Answered
    | Wake
    | Interrupted
    | PlantAdvanced
    | Ordered
    | Chosen
    | Reopened
)

# ---- effects


@dataclass(frozen=True, slots=True)
class Put:
    """Send a message. Telemetry may wait to be batched with what follows, control may not."""

    key: str
    message: Message
    control: bool = False


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer a query."""

    query: int
    message: Message


@dataclass(frozen=True, slots=True)
class Choice:
    """What is applied for one agent, and how its turn went until here."""

    agent: int
    action: int
    outcome: Outcome
    latency: float = 0.0  # seconds from the turn to the decision
    source: str = ""  # `incarnation/sequence` of the decision, which no other decision has


@dataclass(frozen=True, slots=True)
class Order:
    """Ask the plant to carry out an order; Ordered follows."""

    query: int
    order: Work | Operator


@dataclass(frozen=True, slots=True)
class Keep:
    """Write down an order about the team that holds from now on, before anybody is told."""

    order: Team


@dataclass(frozen=True, slots=True)
class Apply:
    """Commit these choices to the plant; PlantAdvanced follows."""

    choices: tuple[Choice, ...]


@dataclass(frozen=True, slots=True)
class Note:
    """Something for the report: what happened to an agent (or to the world: -1), and what waiting it cost."""

    agent: int
    event: str
    waited: float = 0.0


@dataclass(frozen=True, slots=True)
class Count:
    """Something counted."""

    kind: str
    amount: int = 1


@dataclass(frozen=True, slots=True)
class Warn:
    """Something for the log, at most one line per kind and second."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class End:
    """The run, or this agent's part in it, is over."""

    ending: Ending
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Subscribe:
    """Hear a key; what is `quiet` may wait unread until something else is heard or the protocol wants to be woken."""

    key: str
    quiet: bool = False


@dataclass(frozen=True, slots=True)
class Unsubscribe:
    """Hear a key no longer."""

    key: str


@dataclass(frozen=True, slots=True)
class Watch:
    """Hear of a liveliness token."""

    key: str


@dataclass(frozen=True, slots=True)
class Announce:
    """Let a liveliness token stand."""

    key: str


@dataclass(frozen=True, slots=True)
class Withdraw:
    """Take a liveliness token back."""

    key: str


@dataclass(frozen=True, slots=True)
class Ask:
    """Put a question to the world; Answered follows."""

    question: int
    key: str
    message: Message | None


@dataclass(frozen=True, slots=True)
class Choose:
    """Let the policy decide this turn; Chosen follows."""

    turn: Turn


@dataclass(frozen=True, slots=True)
class Reopen:
    """Close the session and open it again; Reopened follows."""


Effect = (
    Put
    | Reply
    | Apply
    | Order
    | Keep
    | Note
    | Count
    | Warn
    | End
    | Subscribe
    | Unsubscribe
    | Watch
    | Announce
    | Withdraw
    | Ask
    | Choose
    | Reopen
)
