"""AirME: crews decide which aircraft to maintain next, before or after it breaks.

![timeline of a fleet](../images/airme.png)

A fleet of fixed-wing aircraft and helicopters flies missions. Every flying hour wears parts whose failure model
(Weibull, hidden from the agents) makes a plane more likely to break; a broken plane earns nothing and takes
12 hours more to repair than one that was taken in time. There are fewer crews than planes. Each crew is an agent:
whenever it is free it chooses a plane to repair, or idles. All crews share one reward, what the fleet earns.

| | |
|---|---|
| Import | `from marl_sched import airme_v0` |
| Agents | `crew_0` .. `crew_7` (`small`), as many as the instance has; padded to the scale's largest |
| Actions | discrete: 0 idles, s > 0 repairs the plane in slot s; parallel: yes; manual control: no |
| Observations | the problem graph as the crew sees it, a Dict with an action mask |
| Reward | of an hour: profit, revenue or availability, the same for all crews |

### Scales
| | fixed-wing | helicopters | crews | slots |
|---|---|---|---|---|
| `small` | 16-24 | 8-12 | 6-8 | 36 + 1 |
| `medium` | 32-48 | 16-24 | 12-16 | 72 + 1 |
| `large` | 64-96 | 32-48 | 24-32 | 144 + 1 |

### Turns
In every hour each free crew has one turn, in ascending order; it sees what the crews before it chose, as far as
its view allows. Then the hour passes, and every hour after it in which no crew is free. In `parallel_env` all free
crews choose at once; where two choose one plane, a counter-based draw decides who has it and the other idles.

### Observation
`{"observation": {...}, "action_mask": int8 (P + 1,)}` with P planes and C crews of the scale's largest instance.
Slot 0 is the null plane. Hidden and padded nodes are zero and leave the masks.

| array | shape | dtype | meaning |
|---|---|---|---|
| `plane` | (P + 1, 18) | float32 | counters, income, mission, repair, age of the snapshot, type |
| `plane_mask` | (P + 1,) | int8 | the plane exists and is visible |
| `crew` | (C, 6) | float32 | free, busy, has chosen, is acting, its job |
| `crew_mask` | (C,) | int8 | the crew exists and is visible |
| `state` | (11,) | float32 | shares and means over the visible planes and crews |
| `repairing` | (C,) | int64 | the slot that a crew repairs or has chosen, -1: none |
| `time` | () | float32 | hour |
| `visible_share` | () | float32 | share of the planes that this crew sees |

`AirmeSimulator.graph` names every feature. `env.infos[agent]` repeats the mask as `action_mask` and holds `time`,
`visible_share` and `conflict`: the crew's previous choice was legal in its view but the plane was already in other
hands, so it idled. `env.state()` is the same graph under the full view.

### Reward and end
After a step `rewards` holds for all crews alike the sum of the rewards of the hours that this step let pass. With
the fleet's total hourly income I, profit is (income of flying planes - repair cost) / I, revenue the first term,
availability the share of planes neither broken nor in repair. After `horizon` hours the episode is truncated;
with `stop_share` it terminates when that share of planes is broken. All crews end together.

### Options of `env`, `raw_env` and `parallel_env`
| option | default | meaning |
|---|---|---|
| `scale` | `"small"` | of the generated instances and of the padding; None: pad to `instance` |
| `instance` | None | an `AirmeInstance` or its file for all episodes; None: each episode draws its own |
| `view` | `"full"` | or `"local"`, `{"kind": "local", "reach": 1, "comm": 1, "staleness": 0}`, `"random"`, an object |
| `objective` | `"profit"` | or `"revenue"`, `"availability"` |
| `horizon` | 720 | hours |
| `seed` | None | of the episodes until a reset gives another; None: drawn anew for every environment |
| `split` | `"train"` | or `"validation"`, `"test"`: instances and noise of different splits never meet |
| `failure` | `"density"` | as published, or `"hazard"` |
| `stop_share` | None | the published early end is 0.8 |
| `flat` | False | True: observations are float32 vectors, the mask beside them (marl_sched.envs.api.layout) |
| `mask` | `"both"` | or `"observation"`, `"info"`: where the action mask is |
| `pad_agents` | False | True: always the scale's largest team; who is absent only does nothing |
| `render_mode` | None | `"ansi"`: a fleet board; `"rgb_array"`: the timeline of every plane |

The view `"random"` is another local view in every episode, drawn within its options `reach_most`, `comm_most`,
`staleness_most` and `fresh_share` (marl_sched.envs.airme.views).

By default an environment plays the split "train", which `marl-sched evaluate` never meets; with `split="test"` episode
0 of `reset(seed=s)` is the first episode of the first instance of `marl-sched evaluate --seed s`.

Unknown options raise TypeError. `reset(seed=s)` starts episode 0 of seed s, `reset()` goes on to the next one, with
a new instance unless one is fixed and with new noise; `reset(options={"instance": ...})` plays that instance once.
A choice that the mask forbids raises `IllegalActionError` and leaves the turn to be taken; in `parallel_env` it
idles the crew, whose info says `illegal`.
`save_state()` and `load_state()` return to any point of an episode; copies by `deepcopy` and `pickle` go on as the
original would.

### Example
```python
from marl_sched import airme_v0

env = airme_v0.env(scale="small", view="local")
env.reset(seed=1)
for agent in env.agent_iter():
    observation, reward, termination, truncation, info = env.last()
    over = termination or truncation
    env.step(None if over else env.action_space(agent).sample(observation["action_mask"]))
```

### Other environment APIs
`gymnasium.make("marl_sched/AirME-v0", scheme="full")` is the dissertation's centralised interface: a step is an hour,
an action a plane for each crew, the view full. Under the scheme `"skip"` the first 0 ends the hour's decisions, under
`"single"` the first decision does. `marl_sched.envs.api.torchrl_env.SchedulingTorchRL("airme", batch_size=1024)` takes
one turn in each of many instances per step, for training; it knows the schemes too.

### Version history
* v0: the simulator of the dissertation, chapter 6, with turns instead of a central list of decisions.

### Source
Zheyuan Wang, *Learning dynamic priority scheduling policies with graph attention networks*, dissertation, Georgia
Institute of Technology, December 2022, chapter 6 (AirME and HetGPO).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Required, TypedDict, Unpack

from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from marl_sched.envs.airme.instance import AirmeInstance
from marl_sched.envs.airme.views import View
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.options import ENVIRONMENT_DEFAULTS, EnvironmentOptions, with_defaults
from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.pettingzoo_ids import register

__all__ = ["AirmeOptions", "env", "parallel_env", "raw_env"]


class LocalViewOptions(TypedDict, total=False):
    """The local view as a mapping; see marl_sched.envs.airme.views.LocalView."""

    kind: Required[Literal["local"]]
    reach: int
    comm: int
    staleness: int


class RandomViewOptions(TypedDict, total=False):
    """The random view as a mapping; see marl_sched.envs.airme.views.RandomView."""

    kind: Required[Literal["random"]]
    reach_most: int
    comm_most: int
    staleness_most: int
    fresh_share: float


class AirmeOptions(EnvironmentOptions, total=False):
    """Options of the AirME environments; the module's page explains them."""

    scale: Literal["small", "medium", "large"] | None
    instance: AirmeInstance | str | Path | None
    view: Literal["full", "local", "random"] | LocalViewOptions | RandomViewOptions | View
    objective: Literal["profit", "revenue", "availability"]
    failure: Literal["density", "hazard"]
    stop_share: float | None
    render_mode: Literal["ansi", "rgb_array"] | None


DEFAULTS: AirmeOptions = {
    "scale": "small",
    "instance": None,
    "view": "full",
    "objective": "profit",
    "horizon": 720,
    "failure": "density",
    "stop_share": None,
    "render_mode": None,
    **ENVIRONMENT_DEFAULTS,
}


def raw_env(**options: Unpack[AirmeOptions]) -> SchedulingAEC:
    """The AEC environment without wrappers; the module's page explains the options."""
    return SchedulingAEC("airme", **with_defaults(DEFAULTS, options))


def env(**options: Unpack[AirmeOptions]) -> OrderEnforcingWrapper:
    """The AEC environment, with PettingZoo's check that it is reset before it is used; options as `raw_env`."""
    return OrderEnforcingWrapper(raw_env(**options))


def parallel_env(**options: Unpack[AirmeOptions]) -> SchedulingParallel:
    """The Parallel environment; options as `raw_env`."""
    return SchedulingParallel("airme", **with_defaults(DEFAULTS, options))


register()
