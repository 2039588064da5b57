import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from marl_sched.noise import Stream, episode_key, integer, mix, time_key, uniform, uniforms, word

WORD = (1 << 64) - 1
GAMMA = 0x9E3779B97F4A7C15
UNIFORM_BELOW_ONE = 1.0 - 2.0**-53

# No draw below depends on chance: a fixed set of names is hashed, so a p-value under this bound is a defect.
P_MIN = 1e-4
N = 1 << 14

u64 = st.integers(0, WORD)


def mix_by_hand(x: int) -> int:
    """The finaliser of SplitMix64 on Python integers, from the paper's constants."""
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & WORD
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & WORD
    return x ^ (x >> 31)


def absorb(key: int, part: int) -> int:
    return mix_by_hand(((key ^ (part & WORD)) + GAMMA) & WORD)


def word_by_hand(seed: int, instance: int, episode: int, time: int, stream: int, entity: int, draw: int) -> int:
    time_word = absorb(absorb(absorb(absorb(0, seed), instance), episode), time)
    name = (stream << 56) | (draw << 40) | entity
    return mix_by_hand((time_word + (name + 1) * GAMMA) & WORD)


def key_of(seed: int, instance: int, episode: int, time: int) -> np.uint64:
    return np.uint64(time_key(np.uint64(episode_key(np.uint64(seed), np.uint64(instance), episode)), time))


def draws(*, seed=1, instance=2, episode=0, time=5, stream=16, entity=3, draw=0, size=N) -> np.ndarray:
    """Uniforms float64 (size,); at most one argument is an array and runs over names."""
    varying = [x for x in (seed, instance, episode, time, stream, entity, draw) if np.ndim(x)]
    size = len(varying[0]) if varying else size
    columns = np.broadcast_arrays(
        *(np.asarray(x) for x in (seed, instance, episode, time, stream, entity, draw)), np.empty(size)
    )
    out = np.empty(size)
    for b, (s, i, e, t, m, n, d) in enumerate(zip(*(column.tolist() for column in columns[:-1]), strict=True)):
        out[b] = uniform(key_of(s, i, e, t), m, n, d)
    return out


AXES = {
    "seed": np.arange(N),
    "instance": np.arange(N),
    "episode": np.arange(N),
    "time": np.arange(N),
    "entity": np.arange(N),
    "draw": np.arange(N),
    "stream": np.arange(256),
}


@pytest.fixture(scope="module", params=AXES)
def along_one_axis(request):
    """Uniforms of names that differ in one part only, which counts up."""
    return draws(**{request.param: AXES[request.param]})


def test_mix_gives_the_published_splitmix64_sequence():
    state, sequence = 1234567, []
    for _ in range(5):
        state = (state + GAMMA) & WORD
        sequence.append(int(mix(np.uint64(state))))
    assert sequence == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]


@given(
    u64,
    u64,
    st.integers(0, 10**6),
    st.integers(0, 10**6),
    st.integers(0, 255),
    st.integers(0, 2**40 - 1),
    st.integers(0, 65535),
)
def test_word_equals_the_hash_on_python_integers(seed, instance, episode, time, stream, entity, draw):
    key = key_of(seed, instance, episode, time)
    assert int(word(key, stream, entity, draw)) == word_by_hand(seed, instance, episode, time, stream, entity, draw)
    assert uniform(key, stream, entity, draw) == (int(word(key, stream, entity, draw)) >> 11) / 2.0**53


def test_negative_seed_is_read_as_a_64_bit_word():
    assert int(episode_key(-1, 0, 0)) == int(episode_key(np.uint64(WORD), 0, 0))


def test_batched_uniforms_are_the_single_ones():
    keys = np.array([episode_key(7, i, 1) for i in range(20)], np.uint64)
    times, entities = np.arange(20), np.arange(20)[::-1].copy()
    batched = uniforms(keys, times, Stream.POLICY, entities, 3)
    single = [uniform(np.uint64(time_key(keys[b], times[b])), Stream.POLICY, entities[b], 3) for b in range(20)]
    assert batched.tolist() == single


def test_uniforms_lie_in_the_half_open_unit_interval(along_one_axis):
    assert along_one_axis.min() >= 0.0
    assert along_one_axis.max() < 1.0


def test_uniforms_are_uniform_along_every_part_of_the_name(along_one_axis):
    assert stats.kstest(along_one_axis, "uniform").pvalue > P_MIN


def test_high_and_low_bits_are_uniform_along_every_part_of_the_name(along_one_axis):
    bits = (along_one_axis * 2.0**53).astype(np.uint64)
    for shift in (0, 26, 48):
        counts = np.bincount(((bits >> np.uint64(shift)) & np.uint64(15)).astype(int), minlength=16)
        assert stats.chisquare(counts).pvalue > P_MIN


@pytest.mark.parametrize("lag", [1, 2, 7, 24])
def test_neighbouring_names_are_independent(along_one_axis, lag):
    first, second = along_one_axis[:-lag], along_one_axis[lag:]
    assert stats.pearsonr(first, second).pvalue > P_MIN
    table = np.histogram2d(first, second, bins=4, range=[[0, 1], [0, 1]])[0]
    assert stats.chisquare(table.ravel()).pvalue > P_MIN


@pytest.mark.parametrize(
    ("part", "one", "other"),
    [
        ("seed", 1, 2),
        ("instance", 2, 3),
        ("episode", 0, 1),
        ("time", 5, 6),
        ("stream", 16, 17),
        ("draw", 0, 1),
        ("draw", 0, 2),
    ],
)
def test_sequences_over_entities_do_not_follow_one_another(part, one, other):
    first, second = (draws(entity=AXES["entity"], **{part: value}) for value in (one, other))
    assert stats.pearsonr(first, second).pvalue > P_MIN
    table = np.histogram2d(first, second, bins=8, range=[[0, 1], [0, 1]])[0]
    assert stats.chisquare(table.ravel()).pvalue > P_MIN
    assert not np.isin(first, second).any()


def test_parts_of_the_name_are_not_exchangeable():
    swapped = [draws(seed=1, instance=2, episode=3, size=1)[0], draws(seed=2, instance=1, episode=3, size=1)[0]]
    swapped += [draws(seed=1, instance=3, episode=2, size=1)[0], draws(seed=3, instance=2, episode=1, size=1)[0]]
    swapped += [draws(time=a, entity=b, draw=c, size=1)[0] for a, b, c in [(1, 2, 3), (2, 1, 3), (1, 3, 2), (3, 2, 1)]]
    assert len(set(swapped)) == len(swapped)


def test_draws_of_one_time_never_share_a_word():
    time_word = key_of(1, 2, 3, 4)
    words = {
        int(word(time_word, s, e, d)) for s in (0, 1, 16, 255) for e in (0, 1, 2, 2**40 - 1) for d in (0, 1, 65535)
    }
    assert len(words) == 4 * 4 * 3


def test_every_bit_of_a_word_flips_every_bit_of_its_hash_half_the_time():
    samples = 2048
    words = [mix_by_hand(i) for i in range(samples)]
    flips = np.zeros((64, 64))
    for x in words:
        before = int(mix(np.uint64(x)))
        for bit in range(64):
            changed = before ^ int(mix(np.uint64(x ^ (1 << bit))))
            flips[bit] += np.unpackbits(np.array([changed], np.uint64).view(np.uint8))
    assert np.abs(flips / samples - 0.5).max() < 5.5 * 0.5 / samples**0.5


@pytest.mark.parametrize(
    ("part", "bits"),
    [("seed", 63), ("instance", 63), ("episode", 31), ("time", 31), ("stream", 8), ("entity", 40), ("draw", 16)],
)
def test_every_bit_of_a_name_flips_half_of_the_word(part, bits):
    order = ("seed", "instance", "episode", "time", "stream", "entity", "draw")
    flipped = []
    for sample in range(64):
        name = dict(zip(order, (sample, 9, 1, 30, 17, 5, 2), strict=True))
        changed = name | {part: name[part] ^ (1 << (sample % bits))}
        pair = []
        for n in (name, changed):
            key = key_of(n["seed"], n["instance"], n["episode"], n["time"])
            pair.append(int(word(key, n["stream"], n["entity"], n["draw"])))
        flipped.append((pair[0] ^ pair[1]).bit_count())
    assert abs(np.mean(flipped) - 32) < 5 * 4 / 64**0.5  # a sum of 64 fair bits: standard deviation 4
    assert min(flipped) > 32 - 6 * 4


def test_integers_reach_both_ends_equally_often():
    values = [integer(u, 2, 8) for u in draws(entity=AXES["entity"])]
    counts = np.bincount(values, minlength=9)
    assert counts[:2].sum() == 0
    assert len(counts) == 9
    assert stats.chisquare(counts[2:]).pvalue > P_MIN


@given(st.integers(-1000, 1000), st.integers(0, 10**6))
def test_integers_never_leave_their_range(low, width):
    assert integer(0.0, low, low + width) == low
    assert integer(UNIFORM_BELOW_ONE, low, low + width) == low + width
