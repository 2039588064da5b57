"""What an update's turns are to a recurrent policy: sequences of each agent's own decisions.

An agent's memory goes through its own turns, which stand between those of others. A sequence is such a run of one
agent's turns within one episode and one update, of at most `longest` turns. Its first memory is the one that was stored
when the turn was taken; those after it are computed again with the present parameters, and gradients flow back to the
sequence's beginning: truncated backpropagation through time from a stored state (R2D2; Kapturowski et al. 2019).
A memory that is only stored would never learn what to remember, and playing whole episodes again would cost all
their turns for each update. Of a sequence's turns those that are not to be learned from have weight 0 and are passed
through. `min_keep_prob` thins turns of memoryless policies alone: within a sequence nothing would be saved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_sched.agents.networks.network import MEMORY, PolicyNetwork, RecurrentNetwork
from marl_sched.graph import TIME, VISIBLE_SHARE

SEQUENCE, PLACE = "sequence", "place"  # int64 (N,): which sequence a turn is of, from 0, and its place there, from 0


def observed_by(network: PolicyNetwork) -> list[str]:
    """The entries of a tensordict that a network reads: arrays of the observation, and a memory if it has one."""
    sizes = {node.name: 1 for node in network.spec.nodes}
    arrays = [name for name in network.spec.arrays(sizes) if name not in (TIME, VISIBLE_SHARE)]
    return [*arrays, MEMORY] if isinstance(network, RecurrentNetwork) else arrays


def logits_of(network: PolicyNetwork, samples: Mapping[str, Tensor] | TensorDictBase) -> Tensor:
    """Logits (N, n_actions) of turns, differentiably; a recurrent network unrolls their sequences."""
    if isinstance(network, RecurrentNetwork):
        return network.unroll(samples, samples[MEMORY], samples[PLACE])
    return network(samples)


def own_sequences(
    agents: Tensor, valid: Tensor, boundary: Tensor, loss_mask: Tensor, longest: int | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The agents' own turns in sequences of at most `longest`, None: of any length.

    Args:
        agents: int64 (T, B), whose turn it was.
        valid: bool (T, B), turns that count.
        boundary: bool (T, B), no later turn of the update goes on from this one.
        loss_mask: bool (T, B), turns to learn from; sequences without any are left out.
        longest: turns of a sequence at most.

    Returns turn, row, sequence and place, int64 (N,) each; sequences stand one after the other.
    """
    turn, row = valid.numpy().nonzero()
    cuts = boundary.numpy()
    episode, agent = (cuts.cumsum(0) - cuts)[turn, row], agents.numpy()[turn, row]
    order = np.lexsort((turn, agent, episode, row))
    turn, row = turn[order], row[order]
    keys = np.stack([row, episode[order], agent[order]])
    new = np.append(True, (keys[:, 1:] != keys[:, :-1]).any(0))[: len(turn)]
    rank = _ranks(new)
    first = new if longest is None else rank % longest == 0
    sequence = first.cumsum() - 1
    learned = np.bincount(sequence, loss_mask.numpy()[turn, row]) > 0
    keep = learned[sequence]
    place = _ranks(first)[keep]
    kept = (turn[keep], row[keep], (place == 0).cumsum() - 1, place)
    turns, rows, sequences, places = (torch.from_numpy(values) for values in kept)
    return turns, rows, sequences, places


def _ranks(first: np.ndarray) -> np.ndarray:
    """How far each place is behind the last one that is marked, bool (N,) of which the first is; int64 (N,)."""
    places = np.arange(len(first))
    return places - np.maximum.accumulate(np.where(first, places, 0))


def minibatches(samples: TensorDictBase, size: int, epochs: int, rng: np.random.Generator) -> Iterator[Tensor]:
    """Index tensors of about `size` samples each; every epoch visits every sample once.

    Sequences stay whole, and their turns stand as `RecurrentNetwork.unroll` expects them.
    """
    sequence = samples.get(SEQUENCE, None)
    count = samples.shape[0]
    parts = max(1, round(count / size))
    if sequence is None:
        for _ in range(epochs):
            yield from torch.from_numpy(rng.permutation(count)).tensor_split(parts)
        return
    lengths = np.bincount(sequence.numpy())
    starts = lengths.cumsum() - lengths
    for _ in range(epochs):
        for chosen in np.array_split(rng.permutation(len(lengths)), min(parts, len(lengths))):
            yield packed(starts[chosen], lengths[chosen])


def packed(starts: np.ndarray, lengths: np.ndarray) -> Tensor:
    """The samples of sequences, given by first sample and length, int64 (S,) each, in the order of a PackedSequence."""
    order = np.argsort(-lengths, kind="stable")
    starts, lengths = starts[order], lengths[order]
    parts = [starts[lengths > place] + place for place in range(int(lengths.max()))]
    return torch.from_numpy(np.concatenate(parts))
