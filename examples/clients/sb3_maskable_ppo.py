"""Stable-Baselines3: one central scheduler, trained by sb3-contrib's MaskablePPO on the Gymnasium environment.

The whole team is one agent here: the action is the joint one (an action for each crew or nurse, in MuRSE the task and
the agent of each place of a round's schedule), and the observation is the full view as a float32 vector (`flat=True`).
Masks: yes. MaskablePPO asks the environment for `action_masks()`, a mask for each part. Parts that clash, such as two
crews that choose one plane, are not excluded by masks of separate parts: the later one idles, and the info lists it.

    pip install stable-baselines3 sb3-contrib
    python examples/clients/sb3_maskable_ppo.py --turns 1000

Ran with stable-baselines3 2.9.2 and sb3-contrib 2.9.2.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import numpy as np
from sb3_contrib import MaskablePPO
from stable_baselines3.common.monitor import Monitor

import marl_sched  # noqa: F401  (registers the environments)


class Counted(gymnasium.Wrapper):
    """Counts parts of joint actions that their masks allowed, and parts that idled an agent, clashes included."""

    legal = forbidden = idled = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Count and pass on."""
        sizes = self.env.get_wrapper_attr("action_space").nvec
        allowed = self.env.get_wrapper_attr("action_masks")()[np.cumsum(sizes) - sizes + action]
        self.legal, self.forbidden = self.legal + int(allowed.sum()), self.forbidden + int((~allowed).sum())
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.idled += len(info["illegal"])
        return observation, reward, terminated, truncated, info


def main() -> int:
    """Train for at least `--turns` steps; 1 where no legal action was seen or a forbidden one was taken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=1000, help="joint actions to train on, at least")
    parser.add_argument("--env", default="marl_sched/AirME-v0", help="name in Gymnasium's registry")
    parser.add_argument("--horizon", type=int, help="of an episode, in the domain's unit and by default its own")
    options = parser.parse_args()
    counted = Counted(gymnasium.make(options.env, flat=True, horizon=options.horizon, seed=1))
    env = Monitor(counted)
    model = MaskablePPO("MlpPolicy", env, n_steps=250, batch_size=50, n_epochs=2, seed=1, device="cpu")
    started = time.perf_counter()
    model.learn(options.turns)
    took = time.perf_counter() - started
    returns = env.get_episode_rewards()
    print(f"{model.num_timesteps} turns, {model.num_timesteps / took:.0f} a second with learning")
    print(f"{counted.legal} legal choices, {counted.forbidden} forbidden, {counted.idled} idled their agents")
    print(f"mean return {np.mean(returns):.1f} of {len(returns)} episodes" if returns else "no episode ended")
    return int(not counted.legal or counted.forbidden > 0)


if __name__ == "__main__":
    raise SystemExit(main())
