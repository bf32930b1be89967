"""The rule's network as one operator: fused on CUDA in float32, plain products elsewhere."""

import pytest
import torch
from support.worlds import assert_same, relative_error

from npa_envs.rule.folded_network import fold_weights
from npa_envs.rule.rule import NPARule

# Norms of errors over norms of answers, against float64; beside, the worst measured on an H200.
FORWARD_TOLERANCE = 1.5e-6  # 2.9e-7
# Of the update, of the gradients by rows (2.1e-7) and by both weights (6.9e-6).
TOLERANCES = (FORWARD_TOLERANCE, 1.5e-6, 3e-5, 3e-5)

SIZES = [
    # space_dim, state_dim, hidden_dim, static
    (2, 16, 128, False),
    (2, 16, 64, False),
    (2, 16, 256, True),
    (3, 16, 256, False),
    (2, 4, 32, False),
    (2, 24, 512, False),
    (3, 24, 128, False),
    # Too narrow and too wide for the fused kernels.
    (2, 16, 24, False),
    (2, 16, 544, False),
]


def trained_like_rule(device, space_dim=2, state_dim=16, hidden_dim=128, static=False):
    torch.manual_seed(0)
    rule = NPARule(space_dim, state_dim, hidden_dim, static=static)
    with torch.no_grad():
        for parameter in rule.parameters():
            parameter.mul_(5.0)
    return rule.to(device)


def random_rows(rule, folded, row_count):
    """Return random rows of perception for which no hidden unit is near 0, the corner of relu."""
    generator = torch.Generator().manual_seed(1)
    rows = torch.zeros(2 * row_count, folded.row_width)
    perception = torch.randn(2 * row_count, rule.perception_dim, generator=generator)
    rows[:, : rule.perception_dim] = perception
    rows[:, rule.perception_dim] = 1.0
    hidden = rows.double() @ folded.hidden_weight.detach().double().cpu().T
    clear = hidden.abs().amin(dim=1) > 1e-6
    return rows[clear][:row_count].to(folded.hidden_weight)


def pulled_back(function, inputs, cotangent):
    """Return a function's result, then the gradients of its inputs for a cotangent."""
    inputs = [value.detach().requires_grad_() for value in inputs]
    update = function(*inputs)
    return update.detach(), *torch.autograd.grad(update, inputs, cotangent.expand_as(update))


@pytest.fixture
def rule(device):
    return trained_like_rule(device)


@pytest.fixture
def folded(rule):
    return rule.folded()


def plain_update(rows, hidden_weight, output_weight):
    return torch.relu(rows @ hidden_weight.T) @ output_weight.T


def needs_cuda(device):
    if device.type != "cuda":
        pytest.skip("the fused network is CUDA's")


@pytest.mark.parametrize("row_count", [1, 33, 2000])
@pytest.mark.parametrize("sizes", SIZES)
def test_network_and_its_gradients_equal_float64(sizes, row_count, device):
    rule = trained_like_rule(device, *sizes)
    folded = rule.folded()
    assert (folded.arranged is not None) == (device.type == "cuda" and sizes[2] not in (24, 544))
    rows = random_rows(rule, folded, row_count)
    inputs = (rows, folded.hidden_weight, folded.output_weight)
    cotangent = torch.randn(row_count, folded.output_weight.shape[0], device=device)
    cotangent *= 10.0 ** torch.linspace(-4.0, 2.0, row_count, device=device)[:, None]
    actual = pulled_back(lambda x, *w: fold_weights(*w)(x), inputs, cotangent)
    wide = [value.double() for value in inputs]
    want = pulled_back(plain_update, wide, cotangent.double())
    for value, answer, tolerance in zip(actual, want, TOLERANCES, strict=True):
        assert relative_error(value, answer) < tolerance


@pytest.mark.parametrize("scale", [1e-20, 1e-6, 1e6, 1e20])
def test_network_is_as_accurate_at_any_scale(scale, rule, folded, device):
    rows = random_rows(rule, folded, 200) * scale
    weights = folded.hidden_weight.double(), folded.output_weight.double()
    expected = plain_update(rows.double(), *weights)
    assert relative_error(folded(rows), expected) < FORWARD_TOLERANCE


def test_a_row_depends_on_no_other_row(rule, folded, device):
    needs_cuda(device)
    rows = random_rows(rule, folded, 1003)
    cotangent = torch.randn(1003, folded.output_weight.shape[0], device=device)
    copies = 2**16 // 1003 + 1
    results = []
    for count in (1, copies):
        wide = rows.repeat(count, 1).requires_grad_()
        update = folded(wide)
        (rows_bar,) = torch.autograd.grad(update, wide, cotangent.repeat(count, 1))
        results.append((update.view(count, 1003, -1), rows_bar.view(count, 1003, -1)))
    for alone, among_others in zip(*results, strict=True):
        assert torch.equal(alone.expand_as(among_others), among_others)
    assert torch.equal(folded(rows[5:6]), folded(rows)[5:6])


def test_network_is_bit_identical_from_run_to_run_and_input_to_input(rule, folded, device):
    rows = random_rows(rule, folded, 5000)
    inputs = (rows, folded.hidden_weight, folded.output_weight)
    cotangent = torch.randn(5000, folded.output_weight.shape[0], device=device)
    runs = [pulled_back(lambda x, *w: fold_weights(*w)(x), inputs, cotangent) for _ in range(2)]
    assert_same(*runs)
    update, *together = runs[0]
    with torch.no_grad():
        assert torch.equal(folded(rows), update)
    assert_same(pulled_back(folded, [rows], cotangent), (update, together[0]))
    total = (folded(rows) * cotangent).sum()
    alone = [torch.autograd.grad(total, w, retain_graph=True)[0] for w in folded[:2]]
    assert_same(alone, together[1:])


def test_rows_may_lie_anywhere(rule, folded, device):
    rows = random_rows(rule, folded, 50)
    shifted = torch.zeros(rows.numel() + 1, device=device)[1:].view_as(rows).copy_(rows)
    strided = rows.repeat_interleave(2, dim=1)[:, ::2]
    ones = torch.ones(50, 1, device=device)
    for same in (shifted, strided):
        assert_same(pulled_back(folded, [same], ones), pulled_back(folded, [rows], ones))


def test_weights_folded_without_gradients_still_have_them(rule):
    with torch.no_grad():
        weights = rule.folded()
    rows = random_rows(rule, weights, 100).requires_grad_()
    (actual,) = torch.autograd.grad(weights(rows).sum(), rows)
    (want,) = torch.autograd.grad(rule.folded()(rows).sum(), rows)
    assert torch.equal(actual, want)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_stay_so(value, rule, folded, device):
    rows = random_rows(rule, folded, 40)
    clean = folded(rows)
    rows[7, 3] = value
    update = folded(rows)
    assert not torch.isfinite(update[7, : rule.update_dim]).any()
    assert torch.equal(update[:7], clean[:7])
    assert torch.equal(update[8:], clean[8:])


def test_rows_of_zeros_give_zeros_and_no_gradient(folded, device):
    rows = torch.zeros(50, folded.row_width, device=device, requires_grad=True)
    update = folded(rows)
    grads = torch.autograd.grad(update.sum(), (rows, *folded[:2]), retain_graph=True)
    assert not update.any()
    assert not any(grad.any() for grad in grads)


def test_a_compiled_network_equals_the_eager_one(rule, device):
    needs_cuda(device)
    rows = random_rows(rule, rule.folded(), 300)

    def squares(rows):
        return rule.folded()(rows).square().sum()

    compiled = torch.compile(squares, backend="aot_eager", fullgraph=True)
    actual = torch.autograd.grad(compiled(rows), list(rule.parameters()))
    want = torch.autograd.grad(squares(rows), list(rule.parameters()))
    assert_same(actual, want)
