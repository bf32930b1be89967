"""Counter-based random draws: Philox4x32-10, and distributions from its 32-bit words.

A word is a function only of a world's key and a counter (element, step, draw, episode), so a
world's draws depend neither on other worlds nor on the device.

Source: Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (SC 2011).
"""

import math
from types import SimpleNamespace

import warp as wp

from npa_envs.kernel_lock import cached_under_lock
from npa_envs.kernels.domain import scalar_name

# Typed constants: a literal in a kernel would be an int32 or a float32.
MULTIPLIER_0 = wp.constant(wp.uint32(0xD2511F53))
MULTIPLIER_1 = wp.constant(wp.uint32(0xCD9E8D57))
WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))
WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))
TWO_PI = wp.constant(wp.float64(2.0 * math.pi))
ULP_24 = wp.constant(wp.float32(2.0**-24))
ULP_32 = wp.constant(wp.float64(2.0**-32))
ULP_53 = wp.constant(wp.float64(2.0**-53))

words = wp.types.vector(4, wp.uint32)


@wp.func
def high_word(a: wp.uint32, b: wp.uint32):
    """Upper 32 bits of a product."""
    return wp.uint32((wp.uint64(a) * wp.uint64(b)) >> wp.uint64(32))


@wp.func
def philox(counter: words, low_key: wp.uint32, high_key: wp.uint32):
    """Return four random words of a counter and a key, after ten rounds."""
    c = counter
    k0 = low_key
    k1 = high_key
    for _round in range(10):
        c = words(
            high_word(MULTIPLIER_1, c[2]) ^ c[1] ^ k0,
            MULTIPLIER_1 * c[2],
            high_word(MULTIPLIER_0, c[0]) ^ c[3] ^ k1,
            MULTIPLIER_0 * c[0],
        )
        k0 += WEYL_0
        k1 += WEYL_1
    return c


@wp.func
def world_words(
    world: wp.int32,
    block: wp.int32,
    draw: wp.int32,
    keys: wp.array(dtype=wp.int64),
    episodes: wp.array(dtype=wp.int32),
    steps: wp.array(dtype=wp.int32),
):
    """Return the four words number `block` of a world's draw, for its next 4 or 2 elements."""
    key = wp.uint64(keys[world])
    counter = words(
        wp.uint32(block), wp.uint32(steps[world]), wp.uint32(draw), wp.uint32(episodes[world])
    )
    return philox(counter, wp.uint32(key), wp.uint32(key >> wp.uint64(32)))


@wp.func
def joined(high: wp.uint32, low: wp.uint32):
    """Join two words to 64 bits."""
    return (wp.uint64(high) << wp.uint64(32)) | wp.uint64(low)


@wp.func
def fraction_53(high: wp.uint32, low: wp.uint32):
    """Return 53 random bits as a number in [0, 1)."""
    return wp.float64(joined(high, low) >> wp.uint64(11)) * ULP_53


@cached_under_lock()
def draw_kernels(scalar: type) -> SimpleNamespace:
    """Return the kernels for one floating type, and how many numbers a thread of each draws."""
    module = wp.get_module(f"npa_envs.kernels.draws_{scalar_name(scalar)}")
    single = scalar is wp.float32
    per_thread = 4 if single else 2

    @wp.kernel(enable_backward=False, module=module)
    def draw_uniform(
        draw: wp.int32,
        keys: wp.array(dtype=wp.int64),
        episodes: wp.array(dtype=wp.int32),
        steps: wp.array(dtype=wp.int32),
        # outputs
        values: wp.array(dtype=scalar, ndim=2),
    ):
        """Write numbers in [0, 1): 24 bits of a word, or 53 bits of two."""
        world, block = wp.tid()
        w = world_words(world, block, draw, keys, episodes, steps)
        for k in range(wp.static(per_thread)):
            element = wp.static(per_thread) * block + k
            if element < values.shape[1]:
                if wp.static(single):
                    values[world, element] = scalar(w[k] >> wp.uint32(8)) * scalar(ULP_24)
                else:
                    values[world, element] = scalar(fraction_53(w[2 * k % 4], w[(2 * k + 1) % 4]))

    @wp.kernel(enable_backward=False, module=module)
    def draw_normal(
        draw: wp.int32,
        keys: wp.array(dtype=wp.int64),
        episodes: wp.array(dtype=wp.int32),
        steps: wp.array(dtype=wp.int32),
        # outputs
        values: wp.array(dtype=scalar, ndim=2),
    ):
        """Write pairs of standard normal numbers by the Box-Muller transform.

        In float64: logarithms of devices differ in the last bit, which rounding to float32 removes.
        """
        world, block = wp.tid()
        w = world_words(world, block, draw, keys, episodes, steps)
        for pair in range(wp.static(per_thread // 2)):
            # The logarithm's argument lies in (0, 1], so the radius is finite.
            amount = wp.float64(0.0)
            turn = wp.float64(0.0)
            if wp.static(single):
                amount = (wp.float64(w[2 * pair]) + wp.float64(1.0)) * ULP_32
                turn = wp.float64(w[2 * pair + 1]) * ULP_32
            else:
                amount = fraction_53(w[0], w[1]) + ULP_53
                turn = fraction_53(w[2], w[3])
            radius = wp.sqrt(wp.float64(-2.0) * wp.log(amount))
            angle = TWO_PI * turn
            element = wp.static(per_thread) * block + 2 * pair
            if element < values.shape[1]:
                values[world, element] = scalar(radius * wp.cos(angle))
            if element + 1 < values.shape[1]:
                values[world, element + 1] = scalar(radius * wp.sin(angle))

    return SimpleNamespace(
        draw_uniform=draw_uniform, draw_normal=draw_normal, per_thread=per_thread
    )


BITS_PER_THREAD = 4
"""Elements that a thread of `draw_bernoulli` draws, one from each word."""

INTEGERS_PER_THREAD = 2
"""Elements that a thread of `draw_integers` draws, one from two words."""


@wp.kernel(enable_backward=False)
def draw_bernoulli(
    threshold: wp.uint64,
    draw: wp.int32,
    keys: wp.array(dtype=wp.int64),
    episodes: wp.array(dtype=wp.int32),
    steps: wp.array(dtype=wp.int32),
    # outputs
    values: wp.array(dtype=wp.uint8, ndim=2),
):
    """Write ones for words below the threshold, at most 2^32, and zeros for others."""
    world, block = wp.tid()
    w = world_words(world, block, draw, keys, episodes, steps)
    for k in range(wp.static(BITS_PER_THREAD)):
        element = wp.static(BITS_PER_THREAD) * block + k
        if element < values.shape[1]:
            bit = wp.uint8(0)
            if wp.uint64(w[k]) < threshold:
                bit = wp.uint8(1)
            values[world, element] = bit


@wp.kernel(enable_backward=False)
def draw_integers(
    high: wp.uint64,
    draw: wp.int32,
    keys: wp.array(dtype=wp.int64),
    episodes: wp.array(dtype=wp.int32),
    steps: wp.array(dtype=wp.int32),
    # outputs
    values: wp.array(dtype=wp.int64, ndim=2),
):
    """Write integers below `high`: 64 random bits modulo it, with a bias of high / 2^64."""
    world, block = wp.tid()
    w = world_words(world, block, draw, keys, episodes, steps)
    for k in range(wp.static(INTEGERS_PER_THREAD)):
        element = wp.static(INTEGERS_PER_THREAD) * block + k
        if element < values.shape[1]:
            values[world, element] = wp.int64(joined(w[2 * k], w[2 * k + 1]) % high)
