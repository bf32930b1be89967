"""Streams of worlds: published answers, independence of the batch, distributions, errors."""

import math

import numpy as np
import pytest
import torch
from worlds import assert_same, lively_rule, random_world

import npa_envs
from npa_envs import WorldRandom
from npa_envs.errors import NPAError
from npa_envs.kernels.portable.draws import draw_words
from npa_envs.ops.launch import launch
from npa_envs.tasks.damage import random_particle
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.randomness import Purpose, check_generator

DRAWS = {
    "uniform": lambda random: random.uniform(5, 3),
    "uniform_float64": lambda random: random.uniform(5, 3, dtype=torch.float64),
    "normal": lambda random: random.normal(5, 3),
    "normal_float64": lambda random: random.normal(5, 3, dtype=torch.float64),
    "bernoulli": lambda random: random.bernoulli(0.3, 37),
    "integers": lambda random: random.integers(1000, 7),
}
SAME_ON_EVERY_DEVICE = ("uniform", "uniform_float64", "bernoulli", "integers")
SIGMAS = 5.0
"""Statistics may be this many standard errors off: one test in a million by chance."""


@pytest.fixture(params=DRAWS.values(), ids=DRAWS.keys())
def draw(request):
    return request.param


@pytest.fixture(scope="module")
def task():
    return Morphogenesis2D(
        Morphogenesis2DConfig(particle_count=333, resolution=33, target_point_count=200)
    )


@pytest.mark.parametrize(
    ("bits", "expected"),
    [
        (0, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        (0xFFFFFFFF, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    ],
    ids=("zeros", "ones"),
)
def test_the_generator_gives_its_published_answers(bits, expected, device):
    counter = torch.full((1, 4), -1 if bits else 0, dtype=torch.int32, device=device)
    words = torch.empty_like(counter)
    launch(draw_words, 1, counter.device, counter, bits, bits, words)
    assert tuple(word & 0xFFFFFFFF for word in words[0].tolist()) == expected


def plain_words(counter, key):
    """Philox4x32-10 in Python's integers."""
    c, (k0, k1), mask = list(counter), key, 0xFFFFFFFF
    for _ in range(10):
        first, second = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [second >> 32 ^ c[1] ^ k0, second & mask, first >> 32 ^ c[3] ^ k1, first & mask]
        k0, k1 = (k0 + 0x9E3779B9) & mask, (k1 + 0xBB67AE85) & mask
    return c


def test_numbers_are_made_of_the_words_of_element_step_draw_and_episode(device):
    random = WorldRandom([41, 42], device=device)
    random.restart()
    random.restart()
    for _ in range(3):
        random.advance()
    keys = [key & 0xFFFFFFFFFFFFFFFF for key in random.keys.tolist()]
    words = [
        [
            [
                word
                for block in range(3)
                for word in plain_words((block, 3, draw, 2), (key & 0xFFFFFFFF, key >> 32))
            ]
            for key in keys
        ]
        for draw in range(6)
    ]
    uniform, wide = random.uniform(11), random.uniform(5, dtype=torch.float64)
    bits, integers = random.bernoulli(0.3, 9), random.integers(12345, 6)
    normal, wide_normal = random.normal(12), random.normal(3, dtype=torch.float64)
    for world in range(2):
        drawn = [words[draw][world] for draw in range(6)]
        pairs = [[(w[k] << 32 | w[k + 1]) for k in range(0, 12, 2)] for w in drawn]
        assert uniform[world].tolist() == [w // 2**8 / 2**24 for w in drawn[0][:11]]
        assert wide[world].tolist() == [w // 2**11 / 2**53 for w in pairs[1][:5]]
        assert bits[world].tolist() == [int(w < round(0.3 * 2**32)) for w in drawn[2][:9]]
        assert integers[world].tolist() == [w % 12345 for w in pairs[3]]
        amounts = [((w + 1) / 2**32, v / 2**32) for w, v in zip(*[iter(drawn[4])] * 2, strict=True)]
        expected = [
            math.sqrt(-2 * math.log(a)) * turn(2 * math.pi * b)
            for a, b in amounts
            for turn in (math.cos, math.sin)
        ]
        assert normal[world].tolist() == pytest.approx(expected, rel=1e-6, abs=1e-7)
        a, b, c, d = (w // 2**11 / 2**53 for w in pairs[5][:4])
        expected = [
            math.sqrt(-2 * math.log(a + 2**-53)) * math.cos(2 * math.pi * b),
            math.sqrt(-2 * math.log(a + 2**-53)) * math.sin(2 * math.pi * b),
            math.sqrt(-2 * math.log(c + 2**-53)) * math.cos(2 * math.pi * d),
        ]
        assert wide_normal[world].tolist() == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_the_numbers_of_a_seed_never_change(device):
    random = WorldRandom(2026, device=device)
    random.restart()
    random.advance()
    assert random.keys.tolist() == [3300764713747675562]
    assert random.bernoulli(0.5, 12).tolist() == [[0, 1, 1, 1, 0, 1, 0, 0, 1, 1, 0, 0]]
    assert random.integers(1000, 5).tolist() == [[754, 14, 437, 835, 375]]
    expected = torch.tensor([[-1.0435505, -0.2878942, 1.6425513]])
    torch.testing.assert_close(random.normal(3).cpu(), expected, rtol=1e-6, atol=1e-6)


def test_keys_are_what_gymnasiums_seeding_gives(device):
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(11)))
    expected = generator.integers(2**64, dtype=np.uint64).view(np.int64)
    assert WorldRandom([3, 11], device=device).keys[1] == int(expected)
    assert torch.equal(
        WorldRandom.from_keys(WorldRandom([3, 11]).keys).uniform(4), WorldRandom([3, 11]).uniform(4)
    )


def test_a_world_draws_in_any_batch_what_it_draws_alone(draw, device):
    random = WorldRandom(range(4), device=device)
    alone = [WorldRandom(seed, device=device) for seed in range(4)]
    for turn in range(4):
        for _ in range(2):
            together = draw(random)
            for world, single in enumerate(alone):
                assert torch.equal(draw(single), together[world : world + 1])
        for streams in (random, *alone):
            streams.restart() if turn == 2 else streams.advance()


HISTORY = {
    "a": WorldRandom.advance,
    "r": WorldRandom.restart,
    "u": lambda random: random.uniform(9),
    "n": lambda random: random.normal(2),
    "b": lambda random: random.bernoulli(0.5, 1000),
}


def after(history, device):
    """Streams after what the letters stand for."""
    random = WorldRandom([5, 6], device=device)
    for letter in history:
        HISTORY[letter](random)
    return random


def assert_all_differ(draws):
    seen = [values for drawn in draws for values in drawn]
    for k, values in enumerate(seen):
        assert all(not torch.equal(values, other) for other in seen[:k])


def test_draws_differ_between_draws_steps_episodes_and_seeds(draw, device):
    assert_all_differ([draw(after(history, device)) for history in ("", "u", "ua", "uar")])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("urab", "urab"),
        # However many draws the step before took.
        ("una", "a"),
        ("unr", "r"),
        # Of whatever kind the draw before was.
        ("u", "b"),
    ],
)
def test_draws_depend_on_episode_step_and_number_alone(one, other, draw, device):
    assert torch.equal(draw(after(one, device)), draw(after(other, device)))
    assert torch.equal(draw(after(one, device).beside(7)), draw(after(other, device).beside(7)))


def test_streams_can_be_taken_restarted_and_put_back(draw, device):
    random = WorldRandom([1, 2, 3, 4], device=device)
    random.advance()
    chosen = torch.tensor([3, 1], device=device)
    part = random.take(chosen)
    assert torch.equal(draw(part), draw(random.take(slice(None)))[chosen])
    part.restart()
    assert random.episodes.tolist() == [0, 0, 0, 0]
    random.put(chosen, part)
    assert random.episodes.tolist() == [0, 1, 0, 1]
    assert random.steps.tolist() == [1, 0, 1, 0]
    random.advance()
    restarted, untouched = (WorldRandom([1, 2, 3, 4], device=device) for _ in range(2))
    restarted.restart()
    restarted.advance()
    untouched.advance()
    untouched.advance()
    values, new, old = draw(random), draw(restarted), draw(untouched)
    assert torch.equal(values[[1, 3]], new[[1, 3]])
    assert torch.equal(values[[0, 2]], old[[0, 2]])


def test_a_copy_goes_on_in_the_middle_of_a_step(draw, device):
    random = WorldRandom([1, 2, 3], device=device)
    random.uniform(5)
    copy = random.take(torch.tensor([2, 0], device=device))
    assert torch.equal(draw(copy), draw(random)[[2, 0]])


def test_no_number_is_drawn_twice_after_streams_were_put_back(draw, device):
    random = WorldRandom([1, 2], device=device)
    part = random.take(slice(0, 1))
    seen = [draw(part), draw(part)]
    random.put(slice(0, 1), part)
    values = draw(random)[:1]
    assert not any(torch.equal(values, before) for before in seen)


def test_putting_other_keys_back_reseeds_those_worlds_alone(device):
    random = WorldRandom([1, 2, 3], device=device)
    random.put(slice(1, 2), WorldRandom(9, device=device))
    assert torch.equal(random.uniform(4), WorldRandom([1, 9, 3], device=device).uniform(4))


def test_keys_beside_are_splitmixs_published_numbers(device):
    random = WorldRandom.from_keys(torch.tensor([1234567, 0], device=device))
    published = (
        (6457827717110365317, 0xE220A8397B1DCDAF),
        (3203168211198807973, 0x6E789E6AA1B965F4),
        (9817491932198370423, 0x06C45D188009454F),
    )
    for purpose, expected in enumerate(published):
        keys = random.beside(purpose).keys.tolist()
        assert tuple(key % 2**64 for key in keys) == expected


def test_streams_beside_draw_apart_from_the_own_and_from_those_of_other_purposes(draw, device):
    random = WorldRandom([5, 6], device=device)
    one, two, three = (random.beside(purpose) for purpose in (1, 2, 3))
    later = after("a", device).beside(1)
    streams = [random, one, two, three, one.beside(2), two.beside(1), later]
    assert_all_differ([draw(stream) for stream in streams])


def test_streams_beside_go_on_from_the_step_they_were_made_in(draw, device):
    random = WorldRandom([5, 6], device=device)
    random.restart()
    early = random.beside(7)
    for stream in (random, early):
        stream.advance()
    assert torch.equal(draw(early), draw(random.beside(7)))


def test_streams_beside_leave_the_own_as_they_are(draw, device):
    random, plain = after("au", device), after("au", device)
    beside = random.beside(1)
    draw(beside)
    beside.restart()
    beside.advance()
    assert_same(
        (random.episodes, random.steps, random.keys), (plain.episodes, plain.steps, plain.keys)
    )
    assert torch.equal(draw(random), draw(plain))


def test_a_world_draws_beside_in_any_batch_what_it_draws_alone(draw, device):
    worlds = [WorldRandom(seed, device=device) for seed in range(4)]
    for _ in range(3):
        worlds[2].restart()
    random = WorldRandom(range(4), device=device)
    random.put(slice(2, 3), worlds[2])
    together = draw(random.beside(5))
    chosen = draw(random.take(torch.tensor([3, 1], device=device)).beside(5))
    for seed, alone in enumerate(worlds):
        assert torch.equal(draw(alone.beside(5))[0], together[seed])
    assert torch.equal(chosen, together[[3, 1]])


def test_streams_beside_are_uncorrelated_with_the_own_and_among_each_other(device):
    random = WorldRandom(range(64), device=device)
    streams = [random, *(random.beside(purpose) for purpose in range(8))]
    drawn = torch.stack([stream.normal(2001).double() for stream in streams])
    for k in range(1, len(drawn)):
        # Also against the neighbouring worlds of other purposes.
        for other in (drawn[:k], drawn[:k].roll(1, dims=1)):
            products = drawn[k] * other
            assert abs(float(products.mean())) < SIGMAS / math.sqrt(products.numel())


def test_no_two_purposes_of_the_package_have_one_number():
    assert len({purpose.value for purpose in Purpose}) == len(Purpose.__members__) >= 4
    assert all(0 < purpose < 1000 for purpose in Purpose)


def test_uniform_and_normal_numbers_have_their_moments(dtype, device):
    random = WorldRandom(range(8), device=device)
    uniform = random.uniform(40_001, dtype=dtype).double()
    normal = random.normal(40_001, dtype=dtype).double()
    assert uniform.dtype == torch.float64
    assert float(uniform.min()) >= 0.0
    assert float(uniform.max()) < 1.0
    for values, moments in (
        (uniform, (1 / 2, 1 / 3, 1 / 4, 1 / 5)),
        (normal, (0.0, 1.0, 0.0, 3.0)),
    ):
        for power, moment in enumerate(moments, start=1):
            samples = values**power
            error = SIGMAS * float(samples.std()) / math.sqrt(samples.numel())
            assert abs(float(samples.mean()) - moment) < error
    assert bool(normal.isfinite().all())
    assert 4.0 < float(normal.abs().max()) < 9.0


@pytest.mark.parametrize("probability", [0.0, 0.05, 0.5, 0.9, 1.0])
def test_ones_come_with_their_probability(probability, device):
    bits = WorldRandom(range(4), device=device).bernoulli(probability, 50_003)
    assert bits.dtype == torch.uint8
    assert set(bits.unique().tolist()) == {0, 1} - {1.0 - probability}
    deviation = math.sqrt(probability * (1.0 - probability) / 50_003)
    assert float((bits.double().mean(dim=1) - probability).abs().max()) <= SIGMAS * deviation


def test_integers_are_uniform_and_below_their_limit(device):
    random = WorldRandom(range(4), device=device)
    values = random.integers(7, 20_000)
    assert values.dtype == torch.int64
    counts = torch.bincount(values.flatten(), minlength=7).double()
    expected = values.numel() / 7
    assert counts.shape == (7,)
    assert float((counts - expected).abs().max()) < SIGMAS * math.sqrt(expected)
    assert random.integers(1, 50).unique().tolist() == [0]
    high = random.integers(2**63 - 1, 2000)
    assert int(high.min()) >= 0
    assert float(high.double().mean() / 2.0**63) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("kind", ["uniform", "normal", "bernoulli"])
def test_neighbouring_worlds_steps_draws_and_particles_are_uncorrelated(kind, device):
    random = WorldRandom(range(64), device=device)
    draw = {
        "uniform": lambda: (random.uniform(513).double() - 0.5) * math.sqrt(12.0),
        "normal": lambda: random.normal(513).double(),
        "bernoulli": lambda: random.bernoulli(0.5, 513).double() * 2.0 - 1.0,
    }[kind]
    values = []
    for _ in range(8):
        random.advance()
        values += [draw(), draw()]
    drawn = torch.stack(values).view(8, 2, 64, 513)
    for dim in range(4):
        size = drawn.shape[dim] - 1
        products = drawn.narrow(dim, 0, size) * drawn.narrow(dim, 1, size)
        assert abs(float(products.mean())) < SIGMAS / math.sqrt(products.numel())


@pytest.mark.gpu
@pytest.mark.parametrize("name", SAME_ON_EVERY_DEVICE)
def test_both_devices_draw_the_same(name):
    here, there = WorldRandom(range(9)), WorldRandom(range(9), device="cuda")
    for random in (here, there):
        random.restart()
        random.advance()
    for _ in range(3):
        assert torch.equal(DRAWS[name](here), DRAWS[name](there).cpu())


@pytest.mark.gpu
def test_both_devices_draw_the_same_normal_numbers_up_to_rounding():
    here, there = (WorldRandom(range(9), device=d).normal(10_000) for d in ("cpu", "cuda"))
    torch.testing.assert_close(there.cpu(), here, rtol=2e-7, atol=1e-9)
    assert float((there.cpu() != here).double().mean()) < 1e-4


@pytest.mark.gpu
def test_a_captured_step_draws_anew_at_each_replay():
    random, eager = (WorldRandom([3, 4], device="cuda") for _ in range(2))
    random.advance()
    random.bernoulli(0.5, 100), random.normal(7)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        random.advance()
        mask, noise = random.bernoulli(0.5, 100), random.normal(7)
    eager.advance()
    for _ in range(3):
        graph.replay()
        eager.advance()
        assert torch.equal(mask, eager.bernoulli(0.5, 100))
        assert torch.equal(noise, eager.normal(7))


@pytest.mark.parametrize("position_noise", [0.0, 1e-3])
def test_a_seeded_world_grows_in_a_batch_as_it_grows_alone(position_noise, task, device):
    """On CUDA up to the rounding of the rule's products, which depends on their size there."""
    rule = npa_envs.load_rule("gecko").to(device)
    steps, tolerance = (64, 0.0) if device.type == "cpu" else (2, 1e-6)

    def grown(seeds):
        random = WorldRandom(seeds, device=device)
        x, s = task.seed(random.world_count, generator=random, device=device)
        with torch.no_grad():
            return npa_envs.rollout(
                rule, x, s, steps, generator=random, position_noise=position_noise
            )

    together = grown([7, 8])
    for world, seed in enumerate((7, 8)):
        for value, expected in zip(grown(seed), together, strict=True):
            assert torch.allclose(value[0], expected[world], rtol=0.0, atol=tolerance)
    assert not torch.equal(together[0][0], together[0][1])


def test_a_rollout_takes_one_step_of_the_stream_for_each_of_its_own(device):
    rule = npa_envs.NPARule(2, 4, 8).to(device)
    x = torch.rand(2, 30, 2, device=device)
    s = torch.rand(2, 30, 4, device=device)
    whole, parts = (WorldRandom([1, 2], device=device) for _ in range(2))
    with torch.no_grad():
        expected = npa_envs.rollout(rule, x, s, 5, generator=whole)
        halfway = npa_envs.rollout(rule, x, s, 2, generator=parts)
        for _ in range(3):
            halfway = npa_envs.step(rule, *halfway, generator=parts)
    assert whole.steps.tolist() == [5, 5]
    assert_same(halfway, expected)


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


def test_balls_and_choices_of_a_world_do_not_depend_on_the_batch(space_dim, device):
    random = WorldRandom(range(5), device=device)
    together = uniform_ball(5, 333, space_dim, 0.2, generator=random, device=device)
    chosen = random_particle(together, random)
    for seed in range(5):
        single = WorldRandom(seed, device=device)
        ball = uniform_ball(1, 333, space_dim, 0.2, generator=single, device=device)
        assert torch.equal(ball[0], together[seed])
        assert torch.equal(random_particle(ball, single)[0], chosen[seed])


def test_points_of_a_ball_are_uniform_in_it(space_dim, device):
    random = WorldRandom(range(4), device=device)
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


def test_shapes_may_be_empty(device):
    random = WorldRandom([1, 2], device=device)
    assert random.uniform().shape == (2,)
    assert random.normal(0, 3).shape == (2, 0, 3)
    assert random.bernoulli(0.5, 4, 0).shape == (2, 4, 0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: WorldRandom(-1), "a seed must be an integer of at least 0, got -1"),
        (lambda: WorldRandom([1, 0.5]), "a seed must be an integer of at least 0, got 0.5"),
        (lambda: WorldRandom("12"), "a seed must be an integer of at least 0, got '1'"),
        (lambda: WorldRandom([]), "seeds must hold at least one seed, got none"),
        (lambda: WorldRandom.from_keys(torch.zeros(3)), "keys must be an int64 .* got torch.flo"),
        (lambda: WorldRandom.from_keys([1]), "keys must be an int64 tensor .* got list"),
        (lambda: WorldRandom(1).beside(-1), "purpose must be an integer of at least 0, got -1"),
        (lambda: WorldRandom(1).beside("x"), "purpose must be an integer of at least 0, got 'x'"),
        (lambda: WorldRandom(1).uniform(-1), "a size must be an integer of at least 0, got -1"),
        (lambda: WorldRandom(1).normal(2, dtype=torch.float16), "dtype must be .* got torch.f.*16"),
        (lambda: WorldRandom(1).bernoulli(1.5, 2), r"probability must lie in \[0, 1\], got 1.5"),
        (lambda: WorldRandom(1).bernoulli(math.nan, 2), r"probability must lie in \[0, 1\]"),
        (lambda: WorldRandom(1).integers(0, 2), r"high must lie in \[1, 2\^63 - 1\], got 0"),
        (lambda: WorldRandom(1).integers(2**63, 2), "high must lie in .* got 9223372036854775808"),
    ],
)
def test_wrong_arguments_are_clear_errors(call, message):
    with pytest.raises(NPAError, match=message):
        call()


def test_streams_must_be_as_many_as_the_worlds(task):
    random = WorldRandom([1, 2, 3])
    message = r"generator must have one stream for each world, B = 2, got 3"
    rule, x, s = npa_envs.NPARule(2, 4, 8), torch.rand(2, 9, 2), torch.rand(2, 9, 4)
    with pytest.raises(NPAError, match=message):
        task.seed(2, generator=random)
    with pytest.raises(NPAError, match=message):
        npa_envs.rollout(rule, x, s, 1, generator=random)
    with pytest.raises(NPAError, match=message):
        random_particle(x, random)


def test_streams_must_be_on_the_worlds_device():
    with pytest.raises(NPAError, match=r"worlds' device, cuda:1, got cpu: make it with W"):
        check_generator(WorldRandom(1), torch.device("cuda", 1), 1)
