"""Counter-based randomness: a stateless hash of what a draw is for gives its value.

A draw is named by (seed, instance, episode, stream, entity, time, draw) and by nothing else. What
happens to plane 7 in hour 130 therefore does not depend on the policy, the batch size, the process or
the order of calls. The manner is that of Salmon et al., "Parallel random numbers: as easy as 1, 2, 3"
(2011); the hash is the finaliser of SplitMix64 (Steele, Lea and Flood, 2014), which costs half a
nanosecond where Philox costs fourteen.

The name is absorbed in two steps, because a simulator reuses the first for thousands of draws:

    time_word = time_key(episode_key(seed, instance, episode), time)
    u = uniform(time_word, stream, entity, draw)

Seeds number problems within a split, and splits never meet: instance i of seed s is another one in "train", in
"validation" and in "test", and so is the noise of its episodes. `marl-sched evaluate`, `compare` and deployments play
"test", whose instance i of seed s is drawn by `numpy.random.default_rng([s, i])`; environments are made for learning
and play "train" unless told otherwise. The scale is not in that name: under one seed, instance i of every scale has its
sizes from the same uniforms, so that a seed with few planes per crew has them on all scales alike. Take another seed
for every scale where results on several scales are to count as independent.

The compiled functions may be called from Python or from other kernels. Called from Python, a key
comes back as a plain int: pass it on as `np.uint64(key)`, since Numba takes plain ints for signed. Streams below
`FIRST_DOMAIN_STREAM` are shared by all domains; a domain numbers its own from there on.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Literal

import numpy as np

from marl_sched.errors import require, require_integer
from marl_sched.kernels import kernel

Split = Literal["train", "validation", "test"]
SPLITS: dict[str, int] = {"test": 0, "train": 1, "validation": 2}
_EPISODES_OF_A_SPLIT = 48  # bits: an episode's number within its split is below 2**48

FIRST_DOMAIN_STREAM = 16

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_S56, _S40 = np.uint64(56), np.uint64(40)
_TO_UNIT = 2.0**-53


class Stream(IntEnum):
    """Streams that every domain shares."""

    POLICY = 0  # a policy's own sampling, entity = agent
    CONFLICT = 1  # which of several agents has its action in the Parallel API, entity = action, draw = agent


def as_seed(seed: Any) -> int:
    """A seed as int in [0, 2**63), which is what an int64 can hold; InvalidOptionError otherwise."""
    return require_integer("seed", seed, 0, 2**63 - 1)


def fresh_seed() -> int:
    """A seed in [0, 2**63) from the operating system's entropy, for environments that were given none."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(1))


def instance_generator(seed: Any, index: int, split: Split = "test") -> np.random.Generator:
    """What instance `index` of a seed is drawn with, another one in every split.

    The word of the split stands behind four words that hold seed and index, and "test" has none, so that no seed
    and index of one split can be those of another. Raises UnknownNameError for the split, InvalidOptionError for
    the seed.
    """
    word = SPLITS[require("split", split, SPLITS)]
    return np.random.default_rng(np.random.SeedSequence([as_seed(seed), index], spawn_key=(word,) if word else ()))


def episode_number(episode: int, split: Split = "test") -> int:
    """The number by which a split's episode is known to the noise: no two splits share one.

    With it a fixed instance, which is the same in all splits, still meets other noise in each of them.
    """
    return episode + (SPLITS[require("split", split, SPLITS)] << _EPISODES_OF_A_SPLIT)


@kernel(inline="always")
def mix(x: np.uint64) -> np.uint64:
    """The finaliser of SplitMix64, a bijection of 64-bit words in which every input bit moves every output bit."""
    x = (x ^ (x >> _S30)) * _MIX_1
    x = (x ^ (x >> _S27)) * _MIX_2
    return x ^ (x >> _S31)


@kernel
def episode_key(seed: int | np.uint64, instance: int | np.uint64, episode: int | np.uint64) -> np.uint64:
    """The key of one episode of one instance; each argument is read as a 64-bit word."""
    key = mix(np.uint64(seed) + _GAMMA)
    key = mix((key ^ np.uint64(instance)) + _GAMMA)
    return mix((key ^ np.uint64(episode)) + _GAMMA)


@kernel(inline="always")
def time_key(episode: np.uint64, time: int) -> np.uint64:
    """The key of one decision epoch of simulated time within an episode."""
    return mix((np.uint64(episode) ^ np.uint64(time)) + _GAMMA)


@kernel(inline="always")
def word(time_word: np.uint64, stream: int, entity: int, draw: int) -> np.uint64:
    """Sixty-four random bits for one draw; `stream` < 256, `draw` < 65536, `entity` < 2**40."""
    name = (np.uint64(stream) << _S56) | (np.uint64(draw) << _S40) | np.uint64(entity)
    return mix(np.uint64(time_word) + (name + np.uint64(1)) * _GAMMA)


@kernel(inline="always")
def uniform(time_word: np.uint64, stream: int, entity: int, draw: int) -> float:
    """A uniform in [0, 1) with 53 random bits."""
    return np.float64(word(time_word, stream, entity, draw) >> _S11) * _TO_UNIT


@kernel(inline="always")
def integer(u: float, low: int, high: int) -> int:
    """The uniform `u` in [0, 1) as an integer of [low, high], both ends included."""
    return low + int(u * (high - low + 1))


@kernel
def uniforms(keys: np.ndarray, times: np.ndarray, stream: int, entities: np.ndarray, draw: int) -> np.ndarray:
    """One uniform per row, float64 (B,), from episode keys (B,), times (B,) and entities (B,)."""
    out = np.empty(keys.shape[0])
    for b in range(keys.shape[0]):
        out[b] = uniform(time_key(keys[b], times[b]), stream, entities[b], draw)
    return out
