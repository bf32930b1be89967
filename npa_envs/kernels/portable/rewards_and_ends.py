"""Rewards, terminations and truncations of episodes, from the worlds' losses."""

import warp as wp

from npa_envs.kernels import native_functions as native
from npa_envs.kernels.lanes_and_memory import wait_for_previous_kernel

SUCCESS, DIVERGED, TIME_LIMIT = 1, 2, 4
"""Bits of an ending, the reasons why an episode is over; 0 while it runs."""

NOT_FINITE = 8
"""Bit of a world whose reward is not finite, which is an error."""

CONTINUE, LIMIT_LOSS, END = 0, 1, 2
"""Effect of divergence on an episode: none; its loss is at least the first loss; it also ends."""


@wp.kernel(module=native.module("npa_envs.kernels.episodes"))
def update_episodes(
    part_count: int,
    last_step: int,
    rewarded_step: int,
    on_divergence: int,
    parts: wp.array[wp.float32],
    enabled: wp.array[wp.uint8],
    diverged: wp.array[wp.uint8],
    first_loss: wp.array[wp.float32],
    success_loss: wp.array[wp.float32],
    broken: wp.array[wp.uint8],
    # changed in place
    elapsed: wp.array[wp.int32],
    numbers: wp.array[wp.float32],
    flags: wp.array[wp.uint8],
    # outputs
    ending_bits: wp.array[wp.uint8],
):
    """Write each world's reward, losses, flags and ending; if not enabled, only endings, all 0.

    `numbers` are the reward, the loss, its parts and their decreases; `flags` are terminated,
    truncated, success and diverged.
    """
    wait_for_previous_kernel()
    world = wp.tid()
    count = elapsed.shape[0]
    is_enabled = enabled[0]
    if world == 0:
        ending_bits[count] = is_enabled
    if is_enabled == wp.uint8(0):
        ending_bits[world] = wp.uint8(0)
        return
    step = elapsed[world] + 1
    has_diverged = diverged[world] != wp.uint8(0)
    penalised = has_diverged and on_divergence != wp.static(CONTINUE)
    loss = parts[world]
    for k in range(1, part_count):
        loss += parts[k * count + world]
    # Divergence must not be rewarded, even where an empty picture is better than the start.
    if penalised and loss < first_loss[world]:
        loss = first_loss[world]
    success = loss <= success_loss[world] and not penalised
    ended = success or (has_diverged and on_divergence == wp.static(END))
    truncated = last_step > 0 and step >= last_step
    improvement = numbers[count + world] - loss
    reward = improvement
    if rewarded_step > 0:
        reward = wp.float32(0.0)
        if ended or step == rewarded_step:
            reward = -loss
    ending = wp.int32(0)
    if success:
        ending += wp.static(SUCCESS)
    if has_diverged:
        ending += wp.static(DIVERGED)
    if truncated:
        ending += wp.static(TIME_LIMIT)
    unfit = not wp.isfinite(improvement)
    if broken.shape[0] > 0 and not penalised:
        unfit = unfit or broken[world] != wp.uint8(0)
    if unfit:
        ending += wp.static(NOT_FINITE)
    elapsed[world] = step
    numbers[world] = reward
    numbers[count + world] = loss
    for k in range(part_count):
        index = (2 + k) * count + world
        part = parts[k * count + world]
        numbers[index + part_count * count] = numbers[index] - part
        numbers[index] = part
    flags[world] = wp.uint8(ended)
    flags[count + world] = wp.uint8(truncated)
    flags[2 * count + world] = wp.uint8(success)
    flags[3 * count + world] = wp.uint8(has_diverged)
    ending_bits[world] = wp.uint8(ending)
