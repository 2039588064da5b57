"""MuRSE: robots and humans share out tasks under deadlines, waits and safety distances, round after round.

![Gantt chart of a round](../images/murse.png)

A team has a list of tasks at places on a map. A task has a duration for each agent, perhaps a deadline, perhaps
others that it has to wait for; tasks that lie close together must not be done at the same time. Humans take less
time the more often they did a task (equation 5.1), and with stochastic durations nobody knows how long exactly: a
Kalman filter estimates it. Each robot and each human is an agent: whenever it is free it commits to a task, or
waits. All agents share one reward. The same tasks come back in every round.

| | |
|---|---|
| Import | `from marl_sched import murse_v0` |
| Agents | `agent_0` .. `agent_4` (`small`), robots first, as many as the instance has; padded to the scale's largest |
| Actions | discrete: 0 waits, i > 0 commits to task i; parallel: yes; manual control: no |
| Observations | the problem graph as the agent sees it, a Dict with an action mask |
| Reward | minus the makespan (or weighted completion time) of a round, the same for all agents |

### Scales
| | tasks | agents | rounds | |
|---|---|---|---|---|
| `small`, `medium`, `large` | 9-11, 18-22, 36-44 | 3-5, at least one robot and one human | 10 | section 5.7.1 |
| `robots-small`, `-medium`, `-large` | 16-20, 40-50, 80-100 | 2-5 robots, 5 locations | 1 | section 3.5 |
| `homogeneous-R-*`, `heterogeneous-R-*` | the same, `xlarge` 160-200 for R = 10 | R = 2, 5, 10 | 1 | 4.4.1, 4.5.1 |
| `weighted-5-small`, `-medium` | 16-20, 40-50 | 5 robots, task costs | 1 | section 4.4.4 |

### Turns
The agent that is free earliest has the turn, among several the one that `picking` prefers. A task can be chosen
when every task that it waits for has been; it starts when its agent, its waits and the tasks nearby that were
dispatched before it allow. `wait` lasts until a task ends, a wait elapses or another agent commits, at least one
time unit. In `online` mode agents decide in real time. In `plan` mode they build the round's schedule on
estimated durations; it is then executed with the true ones in the order of dispatch. In `parallel_env` all free
agents choose at once; where two choose one task, a counter-based draw decides who has it and the other idles one
unit.

### Observation
`{"observation": {...}, "action_mask": int8 (N + 2,)}` with N tasks and A agents of the scale's largest instance.
Task slot 0 is the placeholder s0 (wait), slot n + 1 of an instance with n tasks is f0, which cannot be chosen.
Hidden and padded nodes are zero and leave the masks. Durations and times are in units of the longest duration.

| array | shape | dtype | meaning |
|---|---|---|---|
| `task` | (N + 2, 36) | float32 | status, durations, deadline, believed times, waits, distance, looking ahead |
| `task_mask` | (N + 2,) | int8 | the task exists and is visible |
| `agent` | (A, 9) | float32 | robot or human, acting, when free, share of tasks, distance, price, planned end |
| `agent_mask` | (A,) | int8 | the agent exists and is heard |
| `location` | (N, 3) | float32 | shares of the visible tasks there |
| `location_mask` | (N,) | int8 | a visible task is there |
| `state` | (11,) | float32 | shares and means over what is visible, clock, round, planned end and lateness |
| `temporal`, `aug` | (N + 2, N + 2) | int8 | temporal network on starts, and reversed; `_attributes`: bounds |
| `take_time` | (A, N + 2) | int8 | eligible pairs; `_attributes`: estimate, spread, finish, regret, reduced cost |
| `use_time` | (N + 2, A) | int8 | the same the other way round |
| `assigned_to`, `located_in` | (N + 2,) | int64 | agent and location of a task, -1: none or unknown |
| `near` | (N, N) | int8 | locations too close for work at the same time |
| `decider` | (N + 2,) | int64 | the agent that decides |
| `time` | () | float32 | time units since the episode began |
| `visible_share` | () | float32 | share of the tasks that this agent sees |

`MurseSimulator.graph` names every feature. `env.infos[agent]` repeats the mask as `action_mask` and holds `time`,
`visible_share` and `conflict`: the agent's previous choice was legal in its view but taken by somebody whom it did
not hear, so it idled one unit. `env.state()` is the same graph under the full view.

### Reward and end
A round is feasible when every task is done, every deadline holds on true durations and nobody idled the round away.
It pays minus its makespan, or minus the sum of weight x completion time. An infeasible round costs max(multiplier x
worst case, longest round), so failing never pays better than finishing: the worst case is the largest sum of one
agent's durations over all tasks, the longest round the sum of every task's longest duration and all waits. A round
ends infeasible when all wait for nothing or the clock passes the longest round. The last round's end terminates
the episode for all agents together.

### Options of `env`, `raw_env` and `parallel_env`
| option | default | meaning |
|---|---|---|
| `scale` | `"small"` | of the generated instances and of the padding; None: pad to `instance` |
| `instance` | None | a `MurseInstance` or its file for all episodes; None: each episode draws its own |
| `view` | `"full"` | or `"local"`, `{"kind": "local", "sensing": 4, "comm": 4}` (map units), a view object |
| `objective` | `"makespan"` | or `"weighted"` |
| `horizon` | 10 | rounds, at most as many as the instance has |
| `seed` | None | of the episodes until a reset gives another; None: drawn anew for every environment |
| `split` | `"train"` | or `"validation"`, `"test"`: instances and noise of different splits never meet |
| `mode` | `"plan"` | or `"online"` |
| `picking` | `"first"` | or `"mean_unscheduled"`, `"min_unscheduled"`, `"mean_all"` (section 4.2.2) |
| `rewards` | `"round"` | or `"decision"` (section 3.4.1), `"published"` (equation 5.2 as it stands) |
| `multiplier` | 2.0 | of the worst case in the reward |
| `divisor` | 1.0 | D of section 3.4.1, for `"decision"` |
| `simplification` | `"sparse"` | or `"distance"`: the temporal network's edges (sections 5.4.1, 4.3.1) |
| `durations` | None | `"deterministic"` or `"stochastic"` instead of the instance's own |
| `proximity` | None | `"distance"`, `"location"` or `"none"` instead of the instance's own |
| `flat` | False | True: observations are float32 vectors, the mask beside them (marl_sched.envs.api.layout) |
| `mask` | `"both"` | or `"observation"`, `"info"`: where the action mask is |
| `pad_agents` | False | True: always the scale's largest team; who is absent only does nothing |
| `render_mode` | None | `"ansi"`: commitments; `"rgb_array"`: the last round's Gantt chart, the map before |

By default an environment plays the split "train", which `marl-sched evaluate` never meets; with `split="test"` episode
0 of `reset(seed=s)` is the first episode of the first instance of `marl-sched evaluate --seed s`.

Unknown options raise TypeError. `reset(seed=s)` starts episode 0 of seed s, `reset()` goes on to the next one, with
a new instance unless one is fixed and with new noise; `reset(options={"instance": ...})` plays that instance once.
A choice that the mask forbids raises `IllegalActionError` and leaves the turn to be taken; in `parallel_env` it
idles the agent, whose info says `illegal`.
`save_state()` and `load_state()` return to any point of an episode; copies by `deepcopy` and `pickle` go on as the
original would.

### Example
```python
from marl_sched import murse_v0

env = murse_v0.env(scale="small", mode="online", durations="stochastic")
env.reset(seed=1)
for agent in env.agent_iter():
    observation, reward, termination, truncation, info = env.last()
    over = termination or truncation
    env.step(None if over else env.action_space(agent).sample(observation["action_mask"]))
```

### Version history
* v0: the environment of the dissertation, chapters 3 to 5, with turns instead of a central schedule.

### Source
Zheyuan Wang, *Learning dynamic priority scheduling policies with graph attention networks*, dissertation, Georgia
Institute of Technology, December 2022, chapters 3 (RoboGNN), 4 (ScheduleNet) and 5 (MuRSE and HybridNet).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Required, TypedDict, Unpack

from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.options import ENVIRONMENT_DEFAULTS, EnvironmentOptions, with_defaults
from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.views import FullView, LocalView
from marl_sched.pettingzoo_ids import register

__all__ = ["MurseOptions", "env", "parallel_env", "raw_env"]


class LocalViewOptions(TypedDict, total=False):
    """The local view as a mapping; see marl_sched.envs.murse.views.LocalView."""

    kind: Required[Literal["local"]]
    sensing: float
    comm: float


class MurseOptions(EnvironmentOptions, total=False):
    """Options of the MuRSE environments; the module's page explains them."""

    scale: str | None
    instance: MurseInstance | str | Path | None
    view: Literal["full", "local"] | LocalViewOptions | FullView | LocalView
    objective: Literal["makespan", "weighted"]
    mode: Literal["plan", "online"]
    picking: Literal["first", "mean_unscheduled", "min_unscheduled", "mean_all"]
    rewards: Literal["round", "decision", "published"]
    multiplier: float
    divisor: float
    simplification: Literal["sparse", "distance"]
    durations: Literal["deterministic", "stochastic"] | None
    proximity: Literal["distance", "location", "none"] | None
    render_mode: Literal["ansi", "rgb_array"] | None


DEFAULTS: MurseOptions = {
    "scale": "small",
    "instance": None,
    "view": "full",
    "objective": "makespan",
    "horizon": 10,
    "mode": "plan",
    "picking": "first",
    "rewards": "round",
    "multiplier": 2.0,
    "divisor": 1.0,
    "simplification": "sparse",
    "durations": None,
    "proximity": None,
    "render_mode": None,
    **ENVIRONMENT_DEFAULTS,
}


def raw_env(**options: Unpack[MurseOptions]) -> SchedulingAEC:
    """The AEC environment without wrappers; the module's page explains the options."""
    return SchedulingAEC("murse", **with_defaults(DEFAULTS, options))


def env(**options: Unpack[MurseOptions]) -> OrderEnforcingWrapper:
    """The AEC environment, with PettingZoo's check that it is reset before it is used; options as `raw_env`."""
    return OrderEnforcingWrapper(raw_env(**options))


def parallel_env(**options: Unpack[MurseOptions]) -> SchedulingParallel:
    """The Parallel environment; options as `raw_env`."""
    return SchedulingParallel("murse", **with_defaults(DEFAULTS, options))


register()
