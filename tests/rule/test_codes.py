"""Rules with codes: the code stays, it is perceived, and files, blends and encoders keep it."""

import pytest
import torch
from support.worlds import assert_near, lively_rule, random_world
from test_rule_files import assert_same_rule

import npa_envs
from npa_envs.errors import NPAError
from npa_envs.rule.rule import enlarged

NAMES = ("gecko", "heart", "ring")


def coded(device="cpu", dtype=torch.float64, **options):
    """Return a rule whose seven state channels begin with a code of three."""
    options = {"state_dim": 7, "code_dim": 3, "code_names": NAMES, "eps0": 0.3, **options}
    return lively_rule(device, dtype, **options)


def world_of(rule, device="cpu", world_count=2):
    x, s = random_world(world_count, 60, 2, rule.state_dim, dtype=torch.float64, device=device)
    return x, s.to(rule.hidden.weight)


@pytest.mark.parametrize("static", [False, True])
def test_a_code_stays_as_it_is_and_all_else_changes(static, device):
    rule = coded(device, static=static)
    x, s = world_of(rule, device)
    with torch.no_grad():
        x, after = npa_envs.rollout(rule, x, s, 5)
    assert torch.equal(after[..., :3], s[..., :3])
    assert float((after[..., 3:] - s[..., 3:]).abs().mean(dim=(0, 1)).min()) > 1e-3


def test_the_folded_rule_and_the_module_say_the_same(device):
    rule = coded(device)
    x, s = world_of(rule, device)
    perception = npa_envs.perceive(x, s, eps=0.3)
    rows = torch.nn.functional.pad(perception, (0, 1), value=1.0)
    rows = torch.nn.functional.pad(rows, (0, rule.folded().row_width - rows.shape[-1]))
    folded = rule.folded()(rows.flatten(0, 1))[:, : rule.update_dim]
    assert_near(folded, rule(perception).flatten(0, 1), 1e-12)


def test_a_part_of_the_particles_can_carry_another_code():
    rule = coded()
    _, s = world_of(rule)
    left = torch.arange(60) < 20
    mixed = torch.where(left[:, None], rule.codes["gecko"], rule.codes["ring"])
    carried = rule.with_code(s, mixed.expand(2, -1, -1))
    assert torch.equal(carried[:, :20, :3], rule.codes["gecko"].expand(2, 20, 3))
    assert torch.equal(carried[:, 20:, :3], rule.codes["ring"].expand(2, 40, 3))
    assert torch.equal(carried[..., 3:], s[..., 3:])


def test_codes_are_read_by_name_and_blended_by_shares():
    codes = coded().codes
    assert codes.names == NAMES
    assert torch.equal(codes["heart"], codes.table[1])
    assert len(codes) == 3
    blend = codes.blend({"gecko": 1.0, "ring": 3.0})
    assert_near(blend, 0.25 * codes.table[0] + 0.75 * codes.table[2], 1e-12)


@pytest.mark.parametrize("encoder", [False, True])
def test_a_file_holds_codes_names_and_encoder(encoder, tmp_path):
    rule = coded(dtype=torch.float32, encoder=encoder)
    npa_envs.save_rule(rule, tmp_path / "rule.safetensors")
    loaded = npa_envs.load_rule(tmp_path / "rule.safetensors")
    assert_same_rule(loaded, rule)
    assert loaded.codes.names == NAMES
    if encoder:
        codes = loaded.codes.encode(PICTURES)
        assert torch.equal(codes, rule.codes.encode(PICTURES))
        assert codes.shape == (2, 3)
        assert float(codes.detach().abs().max()) < 1.0


RULE = coded()
PICTURES = torch.rand(2, 48, 48, 4)
STATES = world_of(RULE)[1]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: coded(code_dim=7), "code_dim must be at least 0 and below state_dim = 7"),
        (lambda: coded(code_dim=0), "go together"),
        (lambda: coded(code_names=()), "go together"),
        (lambda: coded(code_names=("a", "a")), "must be different names"),
        *(
            (lambda n=n: coded(code_names=n), "code_names must be a list of names, got .*: for ex")
            for n in (None, 3, "abc", ("a", 1))
        ),
        (lambda: coded(code_names=None, code_dim=0), "must be a list of names, got None"),
        (lambda: coded(equivariant=True), "an equivariant rule .* has no codes"),
        (lambda: RULE.with_code(STATES, torch.zeros(4)), r"code must have shape \[code_dim\]"),
        (lambda: RULE.with_code(STATES, [1.0]), r"code must be a tensor, got \[1\.0\]: for"),
        (lambda: lively_rule("cpu").with_code(STATES, torch.zeros(3)), "has no codes"),
        (lambda: RULE.codes.encode(PICTURES), "has no encoder"),
        (lambda: coded(encoder=True).codes.encode(PICTURES[0]), r"shape \[B, R, R, 4\]"),
        (lambda: RULE.codes["hart"], r"unknown code 'hart'.*heart"),
        (lambda: RULE.codes.blend({"gecko": 1.0, "ring": -1.0}), "add up to more than 0"),
    ],
)
def test_what_does_not_go_together_is_refused(call, message):
    with pytest.raises(NPAError, match=message):
        call()


def test_a_rule_without_codes_gives_its_weights_to_one_enlarged():
    plain = lively_rule("cpu", state_dim=4, eps0=0.3)
    wider = enlarged(plain, coded(hidden_dim=20))
    x, s = world_of(wider)
    wider_s = wider.with_code(s, torch.zeros(3))
    with torch.no_grad():
        # Without the further hidden units it does what the plain rule does.
        wider.output.weight[:, 12:] = 0.0
    random = [npa_envs.WorldRandom([1, 2]) for _ in range(2)]
    ours = npa_envs.rollout(wider, x, wider_s, 4, generator=random[0])
    theirs = npa_envs.rollout(plain, x, s[..., 3:], 4, generator=random[1])
    assert_near(ours[0], theirs[0], 1e-12)
    assert_near(ours[1][..., 3:], theirs[1], 1e-12)
    other = lively_rule("cpu", state_dim=6, eps0=0.3)
    assert enlarged(other, coded()) is other
