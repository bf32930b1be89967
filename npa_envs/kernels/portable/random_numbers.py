"""Counter-based random numbers: Philox4x32-10, and distributions from its 32-bit words.

A word is a function only of a world's key and a counter (element, step, draw, episode), so a
world's random numbers depend neither on other worlds nor on the device.

Source: Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (SC 2011).
"""

import math

import warp as wp

from npa_envs.compile_lock import cached_under_lock

# Typed constants: a literal in a kernel would be an int32 or a float32.
MULTIPLIER_0 = wp.constant(wp.uint32(0xD2511F53))
MULTIPLIER_1 = wp.constant(wp.uint32(0xCD9E8D57))
WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))
WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))
TWO_PI = wp.constant(wp.float64(2.0 * math.pi))
ULP_24 = wp.constant(wp.float32(2.0**-24))
ULP_32 = wp.constant(wp.float64(2.0**-32))
STEP_32 = wp.constant(wp.float32(2.0**-32))
HALF_STEP_32 = wp.constant(wp.float32(2.0**-33))
ULP_53 = wp.constant(wp.float64(2.0**-53))

GOLDEN = 0x9E3779B97F4A7C15
"""Difference of successive states of SplitMix64."""
MIXER_0 = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
MIXER_1 = wp.constant(wp.uint64(0x94D049BB133111EB))

words = wp.types.vector(4, wp.uint32)


@wp.kernel(enable_backward=False, module=wp.get_module("npa_envs.kernels.mixed_keys"))
def mix_keys(
    advance: wp.int64,
    keys: wp.array[wp.int64],
    # outputs
    mixed: wp.array[wp.int64],
):
    """Write the output of SplitMix64 for each key's state, advanced by `advance`.

    Source: Steele, Lea and Flood, "Fast splittable pseudorandom number generators" (OOPSLA 2014).
    """
    world = wp.tid()
    bits = wp.uint64(keys[world]) + wp.uint64(advance)
    bits = (bits ^ (bits >> wp.uint64(30))) * MIXER_0
    bits = (bits ^ (bits >> wp.uint64(27))) * MIXER_1
    mixed[world] = wp.int64(bits ^ (bits >> wp.uint64(31)))


@wp.func
def high_word(a: wp.uint32, b: wp.uint32):
    """Upper 32 bits of the product of two words of 32 bits."""
    return wp.uint32((wp.uint64(a) * wp.uint64(b)) >> wp.uint64(32))


@wp.func
def philox(counter: words, low_key: wp.uint32, high_key: wp.uint32):
    """Return four random words, ten rounds of Philox, from a counter and a key."""
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
    world: int,
    block: int,
    draw: int,
    keys: wp.array[wp.int64],
    episodes: wp.array[wp.int32],
    steps: wp.array[wp.int32],
):
    """Return four random words of a world: 4 `block` to 4 `block` + 3 of its draw `draw`."""
    key = wp.uint64(keys[world])
    counter = words(
        wp.uint32(block), wp.uint32(steps[world]), wp.uint32(draw), wp.uint32(episodes[world])
    )
    return philox(counter, wp.uint32(key), wp.uint32(key >> wp.uint64(32)))


@wp.func
def joined(high: wp.uint32, low: wp.uint32):
    """Return two words joined to 64 bits."""
    return (wp.uint64(high) << wp.uint64(32)) | wp.uint64(low)


@wp.func
def fraction_53(high: wp.uint32, low: wp.uint32):
    """Return 53 random bits as a number in [0, 1)."""
    return wp.float64(joined(high, low) >> wp.uint64(11)) * ULP_53


@wp.kernel(enable_backward=False, module=wp.get_module("npa_envs.kernels.masks_of_torch"))
def draw_masks(
    seed: wp.uint64,
    offset: wp.uint64,
    increment: wp.uint64,
    threads: int,
    probability: float,
    # outputs
    masks: wp.array2d[wp.uint8],
):
    """Write what `bernoulli_` of torch's CUDA generator draws, for each row of masks.

    A call adds `increment` to the generator's offset. Each of its `threads` draws four words at a
    time, for elements that are `threads` apart.
    """
    row, thread = wp.tid()
    call = thread / threads
    block = (offset + wp.uint64(row) * increment) / wp.uint64(4) + wp.uint64(call)
    counter = words(
        wp.uint32(block),
        wp.uint32(block >> wp.uint64(32)),
        wp.uint32(thread % threads),
        wp.uint32(0),
    )
    drawn = philox(counter, wp.uint32(seed), wp.uint32(seed >> wp.uint64(32)))
    for k in range(4):
        element = (4 * call + k) * threads + thread % threads
        if element < masks.shape[1]:
            uniform = wp.float32(drawn[k]) * STEP_32 + HALF_STEP_32
            masks[row, element] = wp.where(uniform < probability, wp.uint8(1), wp.uint8(0))


@cached_under_lock()
def draw_kernel(distribution: str, value_type: type) -> tuple[wp.Kernel, int]:
    """Return the kernel of a distribution, and how many random numbers a thread of it writes.

    "uniform" numbers lie in [0, 1): 24 bits of a word in float32, 53 bits of two in float64.
    "normal" ones are pairs by the Box-Muller transform, in float64: logarithms of devices differ in
    the last bit, which rounding to float32 removes. "bernoulli" ones are 1 for words below `bound`,
    at most 2^32, else 0. "integers" are 64 random bits modulo `bound`, with a bias of bound / 2^64.
    """
    from_one_word = distribution == "bernoulli" or value_type is wp.float32
    count = 4 if from_one_word else 2
    values_type = wp.types.vector(count, value_type)

    @wp.func
    def uniform(w: words, bound: wp.uint64):
        result = values_type()
        for k in range(wp.static(count)):
            if wp.static(from_one_word):
                result[k] = value_type(w[k] >> wp.uint32(8)) * value_type(ULP_24)
            else:
                result[k] = value_type(fraction_53(w[2 * k % 4], w[(2 * k + 1) % 4]))
        return result

    @wp.func
    def normal(w: words, bound: wp.uint64):
        result = values_type()
        for pair in range(wp.static(count // 2)):
            # The logarithm's argument lies in (0, 1], so the radius is finite.
            amount = wp.float64(0.0)
            fraction = wp.float64(0.0)
            if wp.static(from_one_word):
                amount = (wp.float64(w[2 * pair]) + wp.float64(1.0)) * ULP_32
                fraction = wp.float64(w[2 * pair + 1]) * ULP_32
            else:
                amount = fraction_53(w[0], w[1]) + ULP_53
                fraction = fraction_53(w[2], w[3])
            radius = wp.sqrt(wp.float64(-2.0) * wp.log(amount))
            angle = TWO_PI * fraction
            result[2 * pair] = value_type(radius * wp.cos(angle))
            result[2 * pair + 1] = value_type(radius * wp.sin(angle))
        return result

    @wp.func
    def bernoulli(w: words, bound: wp.uint64):
        result = values_type()
        for k in range(wp.static(count)):
            if wp.uint64(w[k]) < bound:
                result[k] = value_type(1)
        return result

    @wp.func
    def integers(w: words, bound: wp.uint64):
        result = values_type()
        for k in range(wp.static(count)):
            result[k] = value_type(joined(w[2 * k], w[2 * k + 1]) % bound)
        return result

    functions = {"uniform": uniform, "normal": normal, "bernoulli": bernoulli, "integers": integers}
    numbers_of, name = functions[distribution], f"{distribution}_{value_type.__name__}"

    @wp.kernel(enable_backward=False, module=wp.get_module(f"npa_envs.kernels.draws_{name}"))
    def draw(
        bound: wp.uint64,
        number: int,
        keys: wp.array[wp.int64],
        episodes: wp.array[wp.int32],
        steps: wp.array[wp.int32],
        # outputs
        values: wp.array2d[value_type],
    ):
        """Write the worlds' random numbers: draw `number` of a step; `bound`: see `draw_kernel`."""
        world, block = wp.tid()
        drawn = numbers_of(world_words(world, block, number, keys, episodes, steps), bound)
        for k in range(wp.static(count)):
            element = wp.static(count) * block + k
            if element < values.shape[1]:
                values[world, element] = drawn[k]

    return draw, count
