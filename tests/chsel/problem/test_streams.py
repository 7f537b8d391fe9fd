"""Random streams: their numbers, their keys, and draws inside kernels."""

import numba
import numpy as np
import pytest
from scipy.stats import kstest

from chsel.errors import SettingError
from chsel.problem.streams import Purpose, StreamKey, fill_uniforms, normals, uniforms


def stream(seed=3):
    return StreamKey(seed, 0).stream(Purpose.EMITTER)


def test_normals_are_made_of_the_raw_output_two_by_two():
    raw = np.random.Philox(key=(int(Purpose.EMITTER) << 84) | 3).random_raw(2000)
    u, v = ((raw >> np.uint64(11)) * 2.0**-53).reshape(-1, 2).T
    radius = np.sqrt(-2.0 * np.log1p(-u))
    angle = 2.0 * np.pi * v
    expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).reshape(-1)
    np.testing.assert_allclose(normals(stream(), 2000), expected, rtol=1e-13, atol=1e-15)


def test_fewer_numbers_are_the_first_of_more_and_take_whole_pairs():
    twelve = normals(stream(), 12)
    for count in (1, 2, 5):
        np.testing.assert_array_equal(normals(stream(), count), twelve[:count])
    np.testing.assert_array_equal(normals(stream(), (2, 3, 2)).reshape(-1), twelve)
    taken = stream()
    first, second = normals(taken, 3), normals(taken, 2)
    np.testing.assert_array_equal(np.append(first, second), twelve[[0, 1, 2, 4, 5]])
    taken = stream()
    assert normals(taken, (4, 0, 2)).shape == (4, 0, 2)
    assert taken.random() == stream().random()


def test_uniforms_fill_their_box():
    lower = np.array([-1.0, 0.0, 5.0])
    upper = np.array([1.0, 0.5, 5.5])
    drawn = uniforms(stream(), lower, upper=upper, shape=(100_000, 3))
    assert (drawn >= lower).all()
    assert (drawn < upper).all()
    for column in ((drawn - lower) / (upper - lower)).T:
        assert kstest(column, "uniform").pvalue > 0.01


def test_streams_of_other_purposes_steps_seeds_and_repetitions_are_others():
    keys = [StreamKey(3, 0), StreamKey(4, 0), StreamKey(3, 1), StreamKey(2**64 - 1, 0)]
    drawn = [key.stream(purpose).random() for key in keys for purpose in Purpose]
    drawn.append(StreamKey(3, 0).stream(Purpose.EMITTER, 1).random())
    assert len(set(drawn)) == 4 * len(Purpose) + 1
    assert StreamKey(3, 0).stream(next(iter(Purpose))).random() == drawn[0]


@pytest.mark.parametrize(("seed", "step"), [(-1, 0), (2**64, 0), (0, -1), (0, 2**32)])
def test_keys_out_of_range_are_refused(seed, step):
    with pytest.raises(SettingError, match=r"accepted: an integer from 0 to 2\*\*"):
        StreamKey(seed, step)


def test_integers_of_numpy_are_seeds_and_steps_too():
    key = StreamKey(np.int64(3), np.uint8(2))
    assert key == StreamKey(3, 2)
    assert type(key.seed) is type(key.step) is int


@numba.njit
def drawn(stream, first, count):
    numbers = np.full(count + 18, np.float32(-1.0))
    fill_uniforms(stream, first, numbers, 2, count)
    return numbers


@pytest.mark.parametrize("first", [0, 3, 8, 1021, 8 * 2**40 + 5])
def test_kernels_draw_the_numbers_of_a_stream_from_any_place(first):
    key = StreamKey(2**64 - 5, 2**32 - 1)
    count = 300
    expected = key.stream(Purpose.WALKS, 7)
    expected.bit_generator.advance(first // 8)
    wanted = expected.random(first % 8 + count, dtype=np.float32)[first % 8 :]
    found = drawn(key.kernel_stream(Purpose.WALKS, 7), first, count)
    np.testing.assert_array_equal(found[2 : 2 + count], wanted)
    assert (found[[0, 1, -2, -1]] == -1.0).all()
