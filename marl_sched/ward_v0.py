"""Ward: nurses decide whom to admit to a delivery ward next, and whom to take over from one another.

![who lay in which bed, with care and without](../images/ward.png)

Women in labour arrive at the sections of a ward over a day. Labour goes through early, active and birth to recovery, by
chance and whether or not anybody cares; a woman in recovery leaves once she has been cared for long enough, and until
then her bed is blocked. Each nurse is an agent with a home section. She admits waiting patients to free beds of her
section, or takes over patients in bed whose nurse has no hand free. She can attend to four units of load at once: early
labour and recovery need one, active labour two, birth four. Whoever waits or lies without care costs, most of all at
birth. Admitting somebody early blocks a bed, walking to another section leaves one's own patients alone: decisions have
to look ahead. All nurses share one reward.

This is a problem for the study of scheduling, not medical software: nothing in it is advice on care, and its numbers
(stages, durations, loads, costs) are invented in the order of magnitude of a day on a ward.

| | |
|---|---|
| Import | `from marl_sched import ward_v0` |
| Agents | `nurse_0` .. `nurse_6` (`small`), as many as the instance has; padded to the scale's largest |
| Actions | discrete: 0 does nothing, s > 0 takes over the patient in slot s; parallel: yes; manual control: no |
| Observations | the problem graph as the nurse sees it, a Dict with an action mask |
| Reward | minus the cost, or the census, of the time that passed, the same for all nurses |

### Scales
| | sections | beds | nurses | patients |
|---|---|---|---|---|
| `small` | 6 | 12 | 6-7 | 26-32 |
| `medium` | 12 | 24 | 12-14 | 52-64 |
| `large` | 24 | 48 | 24-28 | 104-128 |

Sections lie along a corridor; two are as far apart as their numbers. A fifth of the patients is there at the start.

### Turns
Time passes in quarters of an hour. In each of them every nurse who is not on the way or taking over a patient has a
turn, in ascending order; she sees what the nurses before her chose, as far as her view allows. In `parallel_env` all
choose at once; where two choose one patient, a counter-based draw decides who has her and the other does nothing.

An admission takes two quarters of an hour and one for each section that lies between, a takeover in bed one and the
way. Until then the nurse cares for nobody else. Then the quarter passes: nurses attend to their patients (birth first,
then active labour, recovery, early; high risk first), costs are booked, labour progresses, patients leave and arrive.

| stage | load | mean duration, first birth | cost an hour of waiting | in bed without care |
|---|---|---|---|---|
| early | 1 | 4 h, 6 h | 0.5 | 0.25 |
| active | 2 | 3 h, 4.5 h | 2 | 1 |
| birth | 4 | 1 h, 1.5 h | 8 | 8 |
| recovery | 1 | 2 h of care | 4 | 0.5 |

Durations are geometric. Costs of patients at high risk count twice.

### What is not modelled
Shifts and breaks, doctors and theatres, transfer to other wards, a patient's wishes, discharge at night, and any effect
of care on how labour goes.

### Observation
`{"observation": {...}, "action_mask": int8 (P + 1,)}` with P patients, N nurses and K beds of the scale's largest
instance. Slot 0 stands for nobody. Hidden, padded and absent nodes are zero and leave the masks. Who will arrive is
unknown.

| array | shape | dtype | meaning |
|---|---|---|---|
| `patient` | (P + 1, 17) | float32 | stage, risk, bed, care, whose, distance, stay, costs, rank by `marginal-cost` |
| `patient_mask` | (P + 1,) | int8 | the patient is there and visible |
| `nurse` | (N, 6) | float32 | acting, has chosen, quarters busy, load, patients, distance |
| `nurse_mask` | (N,) | int8 | the nurse exists and is heard |
| `bed` | (K, 3) | float32 | free, own section, distance |
| `bed_mask` | (K,) | int8 | the bed exists and is visible |
| `state` | (11,) | float32 | own load, costs and free beds, shares over the visible patients and beds |
| `carer` | (P + 1,) | int64 | the nurse of a patient, -1: none or not heard |
| `place` | (P + 1,) | int64 | the bed of a patient, -1: none |
| `time` | () | float32 | quarters of an hour |
| `visible_share` | () | float32 | share of the patients that this nurse sees |

`WardSimulator.graph` names every feature; patients, nurses and beds are the nodes of the dissertation's figure 7.1.
`env.infos[agent]` repeats the mask as `action_mask` and holds `time`, `visible_share` and `conflict`: the nurse's
previous choice was legal in her view but somebody else had chosen the patient, so she did nothing.

### Reward and end
After a step `rewards` holds for all nurses alike minus what the time that this step let pass added to the objective:
`cost`, of waiting and of missing care, or `census`, patient-hours in the ward, which by Little's law falls where more
patients are discharged. Scores are means per hour, lower is better; `discharged` is reported beside them. After
`horizon` hours the episode is truncated.

### Options of `env`, `raw_env` and `parallel_env`
| option | default | meaning |
|---|---|---|
| `scale` | `"small"` | of the generated instances and of the padding; None: pad to `instance` |
| `instance` | None | a `WardInstance` or its file for all episodes; None: each episode draws its own |
| `view` | `"full"` | or `"local"`, `{"kind": "local", "reach": 1, "comm": 1}`, an object |
| `objective` | `"cost"` | or `"census"` |
| `horizon` | 24 | hours |
| `seed` | None | of the episodes until a reset gives another; None: drawn anew for every environment |
| `split` | `"train"` | or `"validation"`, `"test"`: instances and noise of different splits never meet |
| `flat` | False | True: observations are float32 vectors, the mask beside them (marl_sched.envs.api.layout) |
| `mask` | `"both"` | or `"observation"`, `"info"`: where the action mask is |
| `pad_agents` | False | True: always the scale's largest team; who is absent only does nothing |
| `render_mode` | None | `"ansi"`: a board of the ward; `"rgb_array"`: the timeline of every bed |

In the local view a nurse sees patients and beds of sections within `reach` of her own, and hears nurses whose home is
within `comm`. Unknown options raise TypeError. `reset`, illegal actions and saved states are as in
`marl_sched.airme_v0`.

### Example
```python
from marl_sched import ward_v0

env = ward_v0.env(scale="small", view="local")
env.reset(seed=1)
for agent in env.agent_iter():
    observation, reward, termination, truncation, info = env.last()
    over = termination or truncation
    env.step(None if over else env.action_space(agent).sample(observation["action_mask"]))
```

### Other environment APIs
`gymnasium.make("marl_sched/Ward-v0")` decides for all nurses: an action is a patient for each nurse, a step a quarter
of an hour or longer, the view full. `marl_sched.envs.api.torchrl_env.SchedulingTorchRL("ward", batch_size=1024)` takes
one turn in each of many instances per step, for training.

### Version history
* v0: first version.

### Source
The problem is the one that Zheyuan Wang, *Learning dynamic priority scheduling policies with graph attention networks*,
dissertation, Georgia Institute of Technology, December 2022, proposes as future work in section 7.2: the graph of
figure 7.1, with nurses, beds and patients. How time passes and what costs is our own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Required, TypedDict, Unpack

from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.options import ENVIRONMENT_DEFAULTS, EnvironmentOptions, with_defaults
from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.envs.ward.instance import WardInstance
from marl_sched.envs.ward.views import View
from marl_sched.pettingzoo_ids import register

__all__ = ["WardOptions", "env", "parallel_env", "raw_env"]


class LocalViewOptions(TypedDict, total=False):
    """The local view as a mapping; see marl_sched.envs.ward.views.LocalView."""

    kind: Required[Literal["local"]]
    reach: int
    comm: int


class WardOptions(EnvironmentOptions, total=False):
    """Options of the ward's environments; the module's page explains them."""

    scale: Literal["small", "medium", "large"] | None
    instance: WardInstance | str | Path | None
    view: Literal["full", "local"] | LocalViewOptions | View
    objective: Literal["cost", "census"]
    render_mode: Literal["ansi", "rgb_array"] | None


DEFAULTS: WardOptions = {
    "scale": "small",
    "instance": None,
    "view": "full",
    "objective": "cost",
    "horizon": 24,
    "render_mode": None,
    **ENVIRONMENT_DEFAULTS,
}


def raw_env(**options: Unpack[WardOptions]) -> SchedulingAEC:
    """The AEC environment without wrappers; the module's page explains the options."""
    return SchedulingAEC("ward", **with_defaults(DEFAULTS, options))


def env(**options: Unpack[WardOptions]) -> OrderEnforcingWrapper:
    """The AEC environment, with PettingZoo's check that it is reset before it is used; options as `raw_env`."""
    return OrderEnforcingWrapper(raw_env(**options))


def parallel_env(**options: Unpack[WardOptions]) -> SchedulingParallel:
    """The Parallel environment; options as `raw_env`."""
    return SchedulingParallel("ward", **with_defaults(DEFAULTS, options))


register()
