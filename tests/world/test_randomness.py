"""Streams of worlds: published answers, independence of the batch, distributions, errors."""

import math

import numpy as np
import pytest
import torch
from support.worlds import assert_same, lively_rule, random_world

import npa_envs
from npa_envs import WorldRandom
from npa_envs.errors import NPAError
from npa_envs.ops.physics import Physics
from npa_envs.tasks.damage import random_particle
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.randomness import check_generator, uniform_draws
from npa_envs.world.steps import draw_step, skip_draws

SIZE = 1001
"""Numbers of a world in a draw."""

DRAWS = {
    "uniform": lambda random: random.uniform(77, 13),
    "uniform_float64": lambda random: random.uniform(SIZE, dtype=torch.float64),
    "normal": lambda random: random.normal(7, 143),
    "normal_float64": lambda random: random.normal(SIZE, dtype=torch.float64),
    "bernoulli": lambda random: random.bernoulli(0.3, SIZE),
    "integers": lambda random: random.integers(12345, SIZE),
}
ROUNDING = {"normal": (1e-6, 1e-7), "normal_float64": (1e-12, 1e-14)}
"""Relative and absolute errors of logarithms and angles; all other draws are exact."""

SIGMAS = 5.0
"""Statistics may be this many standard errors off: one test in a million by chance."""


def plain_words(blocks, step, draw, episode, key):
    """Philox4x32-10 in NumPy's integers: four words for each block of a draw, in a row."""
    c = [np.asarray(blocks, np.uint64), *(np.uint64(part) for part in (step, draw, episode))]
    k0, k1, mask = key & 0xFFFFFFFF, key >> 32, 0xFFFFFFFF
    for _ in range(10):
        first, second = c[0] * 0xD2511F53, c[2] * 0xCD9E8D57
        c = [second >> 32 ^ c[1] ^ k0, second & mask, first >> 32 ^ c[3] ^ k1, first & mask]
        k0, k1 = (k0 + 0x9E3779B9) & mask, (k1 + 0xBB67AE85) & mask
    return np.stack(np.broadcast_arrays(*c), axis=1).ravel()


def plain_normals(amounts, turns):
    lengths, angles = np.sqrt(-2.0 * np.log(amounts)), 2.0 * math.pi * turns
    return np.stack((lengths * np.cos(angles), lengths * np.sin(angles)), axis=1).ravel()


def plain_draw(kind, keys, positions):
    """What a world of each key draws at its place: episode, step, number of the draw."""
    rows = []
    for key, (episode, step, number) in zip(keys.tolist(), positions, strict=True):
        w = plain_words(np.arange(SIZE), step, number, episode, key % 2**64)
        pairs = w[::2] << 32 | w[1::2]
        made = {
            "uniform": lambda w, _: w // 2**8 / 2**24,
            "uniform_float64": lambda _, pairs: pairs // 2**11 / 2**53,
            "normal": lambda w, _: plain_normals((w[::2] + 1) / 2**32, w[1::2] / 2**32),
            "normal_float64": lambda _, pairs: plain_normals(
                (pairs[::2] // 2**11 + 1) / 2**53, pairs[1::2] // 2**11 / 2**53
            ),
            "bernoulli": lambda w, _: (w < round(0.3 * 2**32)).astype(float),
            "integers": lambda _, pairs: (pairs % 12345).astype(float),
        }[kind](w, pairs)
        rows.append(torch.from_numpy(made[:SIZE]))
    return torch.stack(rows)


def assert_drawn(kind, random, positions):
    """Draw, and compare with what each world draws at its place."""
    expected = plain_draw(kind, random.keys, positions)
    rtol, atol = ROUNDING.get(kind, (0.0, 0.0))
    drawn = DRAWS[kind](random).cpu().double().flatten(1)
    torch.testing.assert_close(drawn, expected, rtol=rtol, atol=atol)


@pytest.mark.parametrize(
    ("bits", "expected"),
    [
        (0, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        (0xFFFFFFFF, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    ],
    ids=("zeros", "ones"),
)
def test_the_plain_generator_gives_its_published_answers(bits, expected):
    assert plain_words([bits], bits, bits, bits, bits << 32 | bits).tolist() == expected


HISTORY = {
    "a": WorldRandom.advance,
    "r": WorldRandom.restart,
    "u": lambda random: random.uniform(9),
    "n": lambda random: random.normal(2),
    "b": lambda random: random.bernoulli(0.5, 1000),
}


def place_after(history):
    """Episode, step, and number of the next draw."""
    episode = step = number = 0
    for letter in history:
        if letter == "r":
            episode, step, number = episode + 1, 0, 0
        elif letter == "a":
            step, number = step + 1, 0
        else:
            number += 1
    return episode, step, number


@pytest.mark.parametrize("history", ["", "u", "unb", "una", "unr", "urabaan", "rrraaaunbun"])
@pytest.mark.parametrize("kind", DRAWS)
def test_draws_follow_from_key_episode_step_and_number_alone(kind, history, device):
    """Each world of a batch is compared with what it draws alone, beside the own streams too."""
    random = WorldRandom([5, 6, 41], device=device)
    for letter in history:
        HISTORY[letter](random)
    episode, step, number = place_after(history)
    beside = random.substream(7)
    assert_drawn(kind, beside, [(episode, step, 0)] * 3)
    assert_drawn(kind, random, [(episode, step, number)] * 3)
    assert_drawn(kind, random.substream(7), [(episode, step, 0)] * 3)
    beside.advance()
    assert_drawn(kind, beside, [(episode, step + 1, 0)] * 3)
    beside.restart()
    assert_drawn(kind, beside, [(episode + 1, 0, 0)] * 3)
    assert_drawn(kind, random, [(episode, step, number + 1)] * 3)


def test_keys_are_what_gymnasiums_seeding_gives(device):
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(11)))
    expected = generator.integers(2**64, dtype=np.uint64).view(np.int64)
    assert WorldRandom([3, 11], device=device).keys[1] == int(expected)
    keys = WorldRandom([3, 11]).keys
    assert_drawn("uniform", WorldRandom.from_keys(keys), [(0, 0, 0)] * 2)


def test_streams_can_be_taken_restarted_and_put_back(device):
    random = WorldRandom([1, 2, 3, 4], device=device)
    random.advance()
    random.uniform(5)
    chosen = torch.tensor([3, 1], device=device)
    part = random.take(chosen)
    assert torch.equal(part.keys, random.keys[chosen])
    # A copy goes on in the middle of a step, and is one.
    assert_drawn("uniform", part, [(0, 1, 1)] * 2)
    part.restart()
    assert_drawn("uniform", random, [(0, 1, 1)] * 4)
    assert_drawn("uniform", part, [(1, 0, 0)] * 2)
    random.put(chosen, part)
    # All worlds share the number of the next draw, so that none is drawn twice.
    assert_drawn("uniform", random, [(0, 1, 2), (1, 0, 2)] * 2)
    copy = random.take(slice(None))
    random.put(slice(1, 2), WorldRandom(9, device=device))
    random.advance()
    assert random.keys.tolist() == WorldRandom([1, 9, 3, 4]).keys.tolist()
    assert copy.keys.tolist() == WorldRandom([1, 2, 3, 4]).keys.tolist()
    assert_drawn("uniform", random, [(0, 2, 0), (0, 1, 0), (0, 2, 0), (1, 1, 0)])


def test_keys_beside_are_splitmixs_published_numbers(device):
    random = WorldRandom.from_keys(torch.tensor([1234567, 0], device=device))
    published = (
        (6457827717110365317, 0xE220A8397B1DCDAF),
        (3203168211198807973, 0x6E789E6AA1B965F4),
        (9817491932198370423, 0x06C45D188009454F),
    )
    for purpose, expected in enumerate(published):
        keys = random.substream(purpose).keys.tolist()
        assert tuple(key % 2**64 for key in keys) == expected


def test_draws_have_their_dtypes_and_keep_their_limits(device):
    random = WorldRandom(range(4), device=device)
    assert random.uniform().shape == (4,)
    assert random.normal(0, 3).shape == (4, 0, 3)
    assert random.bernoulli(0.5, 4, 0).shape == (4, 4, 0)
    assert random.uniform(3, dtype=torch.float64).dtype == torch.float64
    assert random.normal(3).dtype == torch.float32
    for probability in (0.0, 1.0):
        bits = random.bernoulli(probability, 50_003)
        assert bits.dtype == torch.uint8
        assert bits.unique().tolist() == [probability]
    assert random.integers(1, 50).unique().tolist() == [0]
    high = random.integers(2**63 - 1, 2000)
    assert high.dtype == torch.int64
    assert int(high.min()) >= 0
    assert float(high.double().mean() / 2.0**63) == pytest.approx(0.5, abs=0.02)


def test_the_mask_of_a_step_is_the_streams_first_draw(device):
    # A fresh rule of few units leaves some particles exactly where they are.
    rule = lively_rule(device, torch.float32, 2, 4)
    x, s = random_world(2, 50, 2, 4, dtype=torch.float32, device=device)
    random, copy = (WorldRandom([1, 2], device=device) for _ in range(2))
    with torch.no_grad():
        moved, _ = npa_envs.step(rule, x, s, update_prob=0.3, generator=random)
    copy.advance()
    mask = copy.bernoulli(0.3, 50)
    assert torch.equal((moved != x).any(dim=-1), mask == 1)


@pytest.mark.parametrize("update_prob", [0.5, 1.0])
@pytest.mark.parametrize("position_noise", [0.0, 0.1])
@pytest.mark.parametrize("source", ["worlds", "generator", "torch's own"])
def test_draws_that_are_left_out_are_as_if_drawn(source, position_noise, update_prob, device):
    x = torch.zeros(2, 70_001, 2, device=device)
    physics = Physics(2, 1, 0.1, 0.1, update_prob=update_prob, position_noise=position_noise)
    ways = []
    for leave_out in (False, True):
        torch.manual_seed(4)
        generator = {
            "worlds": lambda: WorldRandom([3, 8], device=device),
            "generator": lambda: torch.Generator(device).manual_seed(4),
            "torch's own": lambda: None,
        }[source]()
        draw_step(x, physics, generator)
        if leave_out:
            skip_draws(x, physics, 5, generator)
            skip_draws(x, physics, 0, generator)
        else:
            for _ in range(5):
                draw_step(x, physics, generator)
        ways.append([uniform_draws(generator, (2, 9), x) for _ in range(2)])
    assert_same(*ways)


@pytest.mark.parametrize("by_world", [True, False])
def test_points_of_a_ball_are_uniform_in_it(by_world, space_dim, device):
    own, torchs = WorldRandom(range(4), device=device), torch.Generator(device).manual_seed(1)
    random = own if by_world else torchs
    points = uniform_ball(
        4, 20_000, space_dim, 0.2, generator=random, device=device, dtype=torch.float64
    )
    distance = points.norm(dim=-1)
    assert float(distance.max()) <= 0.2 * (1.0 + 1e-12)
    # The share of the ball's volume within a point's distance is uniform in [0, 1].
    share = (distance / 0.2) ** space_dim
    count = share.numel()
    assert abs(float(share.mean()) - 0.5) < SIGMAS / math.sqrt(12.0 * count)
    assert abs(float((share**2).mean()) - 1 / 3) < SIGMAS * 0.3 / math.sqrt(count)
    deviation = float(points.std()) / math.sqrt(count)
    assert float(points.mean(dim=(0, 1)).abs().max()) < SIGMAS * deviation


def test_damage_chooses_every_particle_about_equally_often(device):
    random = WorldRandom(range(50), device=device)
    x = torch.arange(10.0, device=device).view(1, 10, 1).expand(50, 10, 2).contiguous()
    counts = torch.zeros(10)
    for _ in range(20):
        random.advance()
        counts += torch.bincount(random_particle(x, random)[:, 0].long().cpu(), minlength=10)
    assert float((counts - 100.0).abs().max()) < SIGMAS * 10.0


CUDA = torch.device("cuda", 1)
RULE, WORLD = npa_envs.NPARule(2, 4, 8), torch.rand(2, 9, 4)
PLACES, THREE = WORLD[..., :2].contiguous(), WorldRandom([1, 2, 3])
AS_MANY = "generator must have one stream for each world, B = 2, got 3"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: uniform_ball(2, 5, 2, 0.2, generator=THREE), AS_MANY),
        (lambda: npa_envs.rollout(RULE, PLACES, WORLD, 1, generator=THREE), AS_MANY),
        (lambda: uniform_ball(10**5000, 5, 2, 0.2), "coordinates must be at most .*, got <int>"),
        (lambda: check_generator(WorldRandom(1), CUDA, 1), "device, cuda:1, got cpu: make it with"),
        (lambda: WorldRandom(-1), "a seed must be an integer of at least 0, got -1"),
        (lambda: WorldRandom([1, 0.5]), "a seed must be an integer of at least 0, got 0.5"),
        (lambda: WorldRandom([]), "seeds must hold at least one seed, got none"),
        (lambda: WorldRandom.from_keys(torch.zeros(3)), "keys must be an int64 .* got torch.flo"),
        (lambda: WorldRandom(1).advance(-1), "steps must be an integer of at least 0, got -1"),
        (lambda: WorldRandom(1).substream(-1), "purpose must be an integer of at least 0, got -1"),
        (lambda: WorldRandom(1).uniform(-1), "a size must be an integer of at least 0, got -1"),
        (lambda: WorldRandom(1).normal(2, dtype=torch.float16), "dtype must be .* got torch.f.*16"),
        (lambda: WorldRandom(1).bernoulli(1.5, 2), r"probability must lie in \[0, 1\], got 1.5"),
        (lambda: WorldRandom(1).integers(0, 2), r"high must lie in \[1, 2\^63 - 1\], got 0"),
        (lambda: WorldRandom(1).integers(2**63, 2), "high must lie in .* got 9223372036854775808"),
    ],
)
def test_wrong_arguments_are_clear_errors(call, message):
    with pytest.raises(NPAError, match=message):
        call()
