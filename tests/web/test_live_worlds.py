"""Live worlds: what each message does to a rule's, a run's and an environment's world."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from npa_envs import NPAError, load_rule, rollout, rollout_species, save_rule
from npa_envs.agents.policies import ZeroPolicy
from npa_envs.rule.files import preset_rules, rule_metadata, shipped_rules
from npa_envs.rule.rule import NPARule, with_division
from npa_envs.tasks.damage import DAMAGE_SIZES
from npa_envs.training import config_to_dict, preset
from npa_envs.training.run_folder import JsonlLog
from npa_envs.web import rule_world
from npa_envs.web.environment_world import EnvironmentWorld, make_environment
from npa_envs.web.live_world import ColouredWorld, Colouring, signed_colours, species_colours
from npa_envs.web.rule_world import RuleWorld, RunWorld
from npa_envs.world.division import living
from npa_envs.world.rollout import rollout_particles

CPU = torch.device("cpu")
COUNT = 96
UNFINISHED = Path(__file__).resolve().parents[1] / "golden" / "unfinished_joint_run"


@pytest.fixture
def gecko(device):
    """A function that makes a small world of geckos."""
    return lambda: RuleWorld("gecko", device=device, particle_count=COUNT)


def brush(name, **fields):
    return {"type": "brush", "tool": name, "at": [0.0, 0.0], "radius": 0.1} | fields


def put(world, **settings):
    """Change settings; return whether the last one has changed the description."""
    for name, value in settings.items():
        changed = world.handle({"type": "set", "name": name, "value": value})
    return changed


def advance(world, count):
    for _ in range(count):
        world.advance()


def world_of(rule: NPARule, path: Path, device: torch.device, **options) -> RuleWorld:
    """A world of a rule that was trained by the preset `paper` with some options."""
    config = config_to_dict(preset("paper", **options))
    stored = {name: config[name] for name in config if name not in ("out", "device")}
    metadata = {"task": "morphogenesis2d", "config": json.dumps(stored)}
    save_rule(rule, path, metadata=metadata)
    return RuleWorld(str(path), device=device)


@pytest.fixture
def world(gecko) -> RuleWorld:
    return gecko()


def test_a_live_world_is_the_rollout_of_its_rule(world):
    put(world, speed=3)
    task, device = world.task, world.particles.x.device
    rule = load_rule("gecko", device=device).float()
    generator = torch.Generator(device).manual_seed(0)
    x, s, *_ = task.seed(1, generator=generator, device=device)
    advance(world, 2)
    with torch.no_grad():
        settings = {"eps": task.eps, "update_prob": task.update_prob, "generator": generator}
        x, s = rollout(rule, x, s, 6, **settings)
    frame = world.frame()
    assert frame.step == 6
    assert frame.milliseconds > 0.0
    np.testing.assert_array_equal(frame.positions, x[0].cpu().numpy())
    own = ((s[0, :, -3:] + 0.5).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    np.testing.assert_array_equal(frame.colours, own.cpu().numpy())


def test_what_is_shown_does_not_change_the_world(gecko):
    plain, watched = gecko(), gecko()
    for show in ("mask", "speed"):
        put(watched, show=show)
        # Before the first step nothing was updated or has moved.
        assert len(np.unique(watched.frame().colours, axis=0)) == 1
    for show in ("mask", "speed", "density", "components", "species", "state 3"):
        put(watched, show=show)
        for world in (plain, watched):
            put(world, speed=2, update_prob=0.25)
            world.advance()
        colours = watched.frame().colours
        assert colours.shape == (COUNT, 3)
        if show == "mask":
            # Four standard deviations of a share of the draws.
            assert abs((colours[:, 0] > 200).mean() - 0.25) < 0.18
        assert torch.equal(plain.particles.x, watched.particles.x)
        assert torch.equal(plain.particles.s, watched.particles.s)


def test_play_step_and_reset(world):
    assert world.playing
    first = world.frame().positions.copy()
    world.handle({"type": "step"})
    assert (world.playing, world.frame().step) == (False, 1)
    world.handle({"type": "play", "on": True})
    assert world.playing
    world.handle({"type": "reset", "seed": 0})
    np.testing.assert_array_equal(world.frame().positions, first)
    world.handle({"type": "reset"})
    assert (world.describe()["seed"], world.frame().step) == (1, 0)
    assert not np.array_equal(world.frame().positions, first)


def test_remove_takes_particles_and_the_others_feel_it_nearby_only(world, gecko):
    other = gecko()
    for live in (world, other):
        live.particles = live.particles._replace(x=4.0 * live.particles.x)
    far = world.particles.x[0, :, 0] > 0.25
    assert not world.handle(brush("remove", at=[-0.2, 0.0], radius=0.15))
    frame = world.frame()
    assert 0 < len(frame.positions) < COUNT
    assert world.take_events() == [{"type": "reordered"}]
    world.handle(brush("remove", at=[5.0, 5.0]))
    assert world.take_events() == []
    assert np.linalg.norm(frame.positions - [-0.2, 0.0], axis=1).min() > 0.15
    assert far.sum() > 3
    for live in (world, other):
        # All are updated, so that both draw nothing.
        put(live, update_prob=1.0, eps=0.05)
        live.advance()
    apart = (world.particles.x[0][:, None] - other.particles.x[0]).norm(dim=-1).min(dim=0).values
    assert float(apart[far].max()) < 1e-6


def test_a_world_without_particles_goes_on(world):
    world.handle(brush("remove", radius=9.0))
    world.advance()
    assert world.frame().positions.shape == (0, 2)
    assert world.frame().colours.shape == (0, 3)
    world.handle({"type": "damage", "name": "cut"})
    world.handle(brush("add", rule="heart", radius=0.2))
    world.advance()
    assert world.describe()["species"] == ["heart"]


def test_a_world_at_rest_is_not_stepped_until_something_changes_it(tmp_path, device, monkeypatch):
    rule = load_rule("gecko")
    # Nothing but a state that is large leaves the zone.
    rule.dead_zone = 40.0
    world = world_of(rule, tmp_path / "resting.safetensors", device, particle_count=COUNT)
    step_counts = []

    def noted(*args, **options):
        step_counts.append(args[2])
        return rollout_particles(*args, **options)

    monkeypatch.setattr(rule_world, "rollout_particles", noted)
    put(world, speed=16)
    advance(world, 8)
    assert step_counts == [16] * 3
    assert world.step == 128
    world.particles.s[0, 3] = 1e4
    put(world, show="colours")
    world.advance()
    assert step_counts == [16] * 4
    world.handle({"type": "reset"})
    put(world, noise=0.002)
    advance(world, 8)
    assert step_counts == [16] * 12


def test_a_world_that_divides_shows_its_living_particles(tmp_path, device):
    rule, path = with_division(load_rule("gecko")), tmp_path / "dividing.safetensors"
    world = world_of(rule, path, device, division=True, particle_count=64)
    assert len(world.frame().positions) == 1
    tools = {brush["name"]: brush["label"] for brush in world.describe()["tools"]}
    assert list(tools) == ["cut", "push", "clump", "noise", "remove"]
    assert tools["remove"].endswith("makes room for new ones")
    put(world, speed=8)
    for show in ("colours", "mask", "speed", "density", "components", "species", "state 3"):
        put(world, show=show)
        world.advance()
        alive = living(world.particles.s)[0]
        frame = world.frame()
        np.testing.assert_array_equal(frame.positions, world.particles.x[0, alive].cpu().numpy())
        assert frame.colours.shape == (int(alive.sum()), 3)
    assert int(alive.sum()) == 64
    world.handle(brush("remove", radius=9.0))
    world.advance()
    assert world.particles.x.shape == (1, 64, 2)
    assert len(world.frame().positions) == 0
    with pytest.raises(NPAError, match="unknown brush 'graft'"):
        world.handle(brush("graft", rule="gecko"))


def test_what_is_added_to_a_world_of_a_rule_with_codes_carries_one(device):
    world = RuleWorld("seven-pictures", device=device, particle_count=64)
    code = world.main.rule.codes["gecko"]
    world.handle(brush("add", rule="seven-pictures", at=[0.5, 0.0]))
    assert world.particles.x.shape[1] > 64
    for damage in DAMAGE_SIZES:
        world.handle({"type": "damage", "name": damage})
    world.handle(brush("graft", rule="seven-pictures"))
    world.handle(brush("wipe"))
    assert torch.equal(world.particles.s[0, :, :8], code.expand(world.particles.s.shape[1], 8))


def test_a_brush_changes_states_or_positions_where_it_is(world):
    advance(world, 8)
    for name, fields in (
        ("wipe", {}), ("inject", {"source": [0.2, 0.0]}), ("push", {"move": [0.05, 0.0]}),
        ("clump", {}), ("noise", {}), ("cut", {"move": [0.1, 0.0], "radius": 0.05}),
    ):  # fmt: skip
        x, s, *_ = world.particles
        assert not world.handle(brush(name, **fields))
        changed = [
            (before != after).any(dim=-1)[0]
            for before, after in zip((x, s), world.particles[:2], strict=True)
        ]
        moves = name in ("push", "clump", "noise", "cut")
        assert 0 < int(changed[not moves].sum()) < COUNT
        assert not changed[moves].any()
        assert float(x[0, changed[not moves]].norm(dim=-1).max()) < 0.15


def test_grafts_follow_the_other_rule(world):
    assert world.handle(brush("graft", rule="heart", radius=0.15))
    description = world.describe()
    assert description["species"] == ["gecko", "heart"]
    inside = np.linalg.norm(world.frame().positions, axis=1) <= 0.15
    assert world.counts == [COUNT - inside.sum(), inside.sum()]
    # Species after species: those within follow the second.
    assert inside[world.counts[0] :].all()
    # The page's tracers must know.
    assert world.take_events() == [{"type": "reordered"}]
    world.advance()
    put(world, show="species")
    np.testing.assert_array_equal(
        world.frame().colours, species_colours(2).repeat(world.counts, axis=0)
    )
    assert world.handle(brush("graft", rule="gecko", radius=9.0))
    assert world.describe()["species"] == ["gecko"]


def test_a_seed_that_is_added_grows_as_it_would_alone(world):
    put(world, update_prob=1.0)
    world.handle(brush("add", rule="heart", at=[30.0, 0.0], radius=0.2, strength=1.0))
    assert world.counts == [COUNT, COUNT // 2]
    heart = world.particles.x[:, COUNT:].clone(), world.particles.s[:, COUNT:].clone()
    advance(world, 2)
    rule = load_rule("heart", device=world.particles.x.device).float()
    with torch.no_grad():
        x, s = rollout(rule, *heart, 2, update_prob=1.0)
    torch.testing.assert_close(world.particles.x[:, COUNT:], x, rtol=0.0, atol=2e-5)
    torch.testing.assert_close(world.particles.s[:, COUNT:], s, rtol=0.0, atol=1e-3)


def test_every_field_of_particles_lives_through_steps_brushes_and_damage(world):
    advance(world, 3)
    velocity = torch.rand(1, COUNT, device=world.particles.x.device)
    world.particles = world.particles._replace(path_length=velocity)
    for name in DAMAGE_SIZES:
        before = world.particles
        world.handle({"type": "damage", "name": name})
        assert not all(map(torch.equal, before[:2], world.particles[:2]))
    world.handle(brush("graft", rule="heart", radius=0.15))
    order = [(world.particles.path_length[0] == value).nonzero().item() for value in velocity[0]]
    x = world.particles.x
    assert sorted(order) == list(range(COUNT))
    world.handle(brush("add", rule="heart", at=[30.0, 0.0]))
    added = world.particles.path_length.shape[1] - COUNT
    assert added == world.particles.x.shape[1] - COUNT > 0
    for name in ("push", "clump", "cut", "inject"):
        world.handle(brush(name))
    world.advance()
    world.handle(brush("remove", at=[30.0, 0.0], radius=1.0))
    assert torch.equal(world.particles.path_length[:, order], velocity)
    assert world.particles.x.shape == x.shape


def test_settings_change_the_world_and_its_description(world):
    for name, value in (("eps", 0.12), ("update_prob", 0.05), ("noise", 0.01), ("speed", 4)):
        assert put(world, **{name: value})
        assert world.describe()["settings"][name]["value"] == value
    before = world.particles.x.clone()
    world.advance()
    assert world.step == 4
    # Noise also moves particles that are not updated.
    assert bool((world.particles.x != before).any(dim=-1).all())
    put(world, noise=0.0, speed=1)
    before = world.particles.x.clone()
    world.advance()
    assert int((world.particles.x != before).any(dim=-1).sum()) < COUNT // 2
    put(world, count=64)
    assert len(world.frame().positions) == 64
    assert world.describe()["settings"]["eps"]["value"] == 0.12


def test_another_rule_is_another_world(world):
    assert world.describe()["shows"][-4:-2] == ["state 12", "state 13 (red)"]
    put(world, show="state 15 (blue)")
    assert put(world, rule="dots")
    description = world.describe()
    expected = {"rule": "dots", "box": [2.0, 2.0], "half_width": 1.0}
    assert description == description | expected
    assert "dots" in description["others"]
    assert "gecko" not in description["others"]
    with pytest.raises(NPAError, match="gecko cannot live in a world of dots"):
        world.handle(brush("graft", rule="gecko"))


def test_the_loss_is_computed_only_where_it_is_wanted(world, monkeypatch):
    assert world.frame().loss is None
    # The next loss is due only after a long time.
    monkeypatch.setattr(rule_world, "LOSS_FRACTION", 1e-9)
    put(world, loss=True)
    world.advance()
    loss = world.frame().loss
    assert loss == pytest.approx(float(world.task.metric(world.particles.x, world.particles.s)))
    assert world.frame().loss is None


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ({}, "unknown message None"), ([], "unknown message None"),
        ({"type": "fly"}, "unknown message 'fly'"),
        ({"type": "reset", "seed": -1}, r"seed must be a whole number in \[0, 9"),
        ({"type": "reset", "seed": 0.5}, "seed must be a whole number"),
        ({"type": "set"}, "unknown setting 'None'"),
        ({"type": "set", "name": ["eps"], "value": 0.1}, "unknown setting"),
        ({"type": "set", "name": "eps", "value": 0.0}, r"eps must be a number in \[0\.04, 0\.25\]"),
        ({"type": "set", "name": "eps", "value": float("nan")}, "eps must be a number"),
        ({"type": "set", "name": "eps", "value": "1"}, "eps must be a number in"),
        ({"type": "set", "name": "count", "value": 10**9}, "count must be a whole number in"),
        ({"type": "set", "name": "speed", "value": 0}, "speed must be a whole number in"),
        ({"type": "set", "name": "rule", "value": "/etc/passwd"}, "unknown rule '/etc/passwd'"),
        ({"type": "set", "name": "rule", "value": ["gecko"]}, "unknown rule"),
        ({"type": "set", "name": "show", "value": "state 16"}, "unknown show 'state 16'"),
        ({"type": "damage", "name": "burn"}, "unknown damage 'burn'"),
        ({"type": "damage", "name": []}, "unknown damage"),
        (brush("paint"), "unknown brush 'paint'"), (brush(["remove"]), "unknown brush"),
        (brush("remove", at=[0.0]), "at must be 2 finite numbers, got"),
        (brush("remove", at=[0.0, float("inf")]), "at must be 2 finite numbers"),
        (brush("remove", at="00"), "at must be 2 finite numbers"),
        (brush("remove", radius=-1), "radius must be a number in"),
        (brush("push", move=[1e9, 0.0]), "move must be 2 finite numbers"),
        (brush("inject", source=[0.0]), "source must be 2 finite numbers"),
        (brush("push", strength=2), "strength must be a number in"),
        (brush("graft", rule="worm"), "unknown rule 'worm'"),
        (brush("graft", rule="duck"), "duck cannot live in a world of gecko"),
    ],
)  # fmt: skip
def test_a_wrong_message_is_rejected_and_changes_nothing(shared, message, error):
    particles, description = shared.particles, shared.describe()
    with pytest.raises(NPAError, match=error):
        shared.handle(message)
    assert shared.particles is particles
    assert shared.describe() == description


@pytest.fixture(scope="module")
def shared():
    """One world for all messages that must leave it as it is."""
    return RuleWorld("gecko", device=CPU, particle_count=COUNT)


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_rules())
def test_every_shipped_rule_can_be_viewed(name, device):
    world = RuleWorld(name, device=device)
    description = world.describe()
    assert name in description["others"]
    for show in (*description["shows"][:6], "state 0"):
        put(world, show=show)
        world.advance()
        frame = world.frame()
        assert frame.positions.shape == (world.count, description["dimension"])
        assert frame.colours.shape == (world.count, 3)
        middle = np.array(description["centre"])
        inside = np.abs(frame.positions - middle).max(axis=1) <= 1.1 * description["half_width"]
        assert inside.mean() > 0.95
    put(world, loss=True)
    loss = world.frame().loss
    measurable = world.trained.why_not_measurable is None
    assert np.isfinite(loss) if measurable else loss is None


# Colours.


GENERATOR = torch.Generator().manual_seed(3)
X = torch.rand(1, 50, 2, generator=GENERATOR)
S = torch.randn(1, 50, 6, generator=GENERATOR)


def colours_of(show, colouring=None, x=X, s=S):
    """Return the colours of an open world as signed numbers."""
    count = x.shape[1]
    world = ColouredWorld(x, s, lambda s: s[..., -3:], 0.2, None, [count], count, None, None)
    return (colouring or Colouring())(show, world).astype(int)


def test_zero_is_grey_and_signs_are_opposite():
    grey, low, high = (signed_colours(torch.tensor([v]))[0] for v in (0.0, -2.0, 2.0))
    assert float(grey.max() - grey.min()) < 0.02
    assert low[2] > low[0] + 0.2
    assert high[0] > high[2] + 0.2


def test_components_do_not_flip_and_leave_out_particles_that_are_no_number():
    colouring = Colouring()
    first = colours_of("components", colouring)
    later = colours_of("components", colouring, s=S * torch.tensor([1.0, 1, 1.01, 1, 1, 1]))
    assert np.abs(first - later).max() < 30
    assert first.std() > 20
    s = torch.cat((S, S[:, :2]), dim=1)
    s[0, 50, 1], s[0, 51, 2] = float("nan"), float("inf")
    colouring = Colouring()
    broken = colours_of("components", colouring, x=torch.cat((X, X[:, :2]), dim=1), s=s)
    np.testing.assert_array_equal(broken[:50], first)
    # A world of nothing else is not remembered.
    colours_of("components", colouring, s=torch.full_like(S, float("nan")))
    assert colours_of("components", colouring).std() > 20


def test_crowded_particles_are_brighter():
    crowd = torch.cat((0.01 * torch.rand(1, 25, 2), 1.0 + torch.rand(1, 25, 2)), dim=1)
    brightness = colours_of("density", x=crowd).sum(axis=1)
    assert brightness[:25].min() > brightness[25:].max()


# Runs.


def write_run(folder: Path, name: str = "gecko", rule: NPARule | None = None) -> None:
    folder.mkdir(exist_ok=True)
    metadata = rule_metadata((shipped_rules() | preset_rules())[name])
    stored = {key: metadata[key] for key in ("task", "config") if key in metadata}
    save_rule(rule or load_rule(name), folder / "rule.safetensors", metadata=stored)
    (folder / "config.json").write_text("{}", encoding="utf-8")
    if not (folder / "log.jsonl").exists():
        log(folder, 0, 10)


def trained_on(name: str) -> NPARule:
    """A rule with other weights, as a run has it some iterations later."""
    rule = load_rule(name)
    with torch.no_grad():
        for parameter in rule.parameters():
            parameter.mul_(0.9)
    return rule


def log(folder: Path, first: int, end: int) -> None:
    with (folder / "log.jsonl").open("a", encoding="utf-8") as file:
        for k in range(first, end):
            file.write(json.dumps({"iteration": k, "loss": 1.0 / (k + 1)}) + "\n")


def polled(world: RunWorld) -> list[dict]:
    """Return a world's events after it has read its run's files."""
    world._poll_due = 0.0
    return world.take_events()


def points(world: RunWorld) -> list[tuple]:
    return [(event["append"], event["points"]) for event in polled(world) if "points" in event]


@pytest.fixture
def followed(tmp_path) -> RunWorld:
    """A world of a run of the gecko in the test's folder."""
    write_run(tmp_path)
    return RunWorld(tmp_path, device=CPU, particle_count=COUNT)


def test_a_run_is_followed(tmp_path, followed):
    world = followed
    curve, description = world.take_events()
    assert (curve["points"], curve["append"]) == ([[k, 1.0 / (k + 1)] for k in range(10)], False)
    assert description["note"] == "a training run, iteration 9"
    assert description["title"] == tmp_path.name
    assert world.take_events() == []
    world.advance()
    x = world.particles.x
    newer = trained_on("gecko")
    write_run(tmp_path, rule=newer)
    log(tmp_path, 10, 12)
    curve, description = (event for event in polled(world) if event["type"] != "error")
    assert (curve["points"], curve["append"]) == ([[10, 1.0 / 11], [11, 1.0 / 12]], True)
    assert description["note"] == "a training run, iteration 11"
    assert torch.equal(world.main.rule.hidden.weight, newer.hidden.weight)
    # The world lives on.
    assert world.particles.x is x
    assert world.step == 1
    assert polled(world) == []


@pytest.mark.filterwarnings("ignore:.*has no checksum")
def test_a_run_of_several_rules_is_one_world_of_them(tmp_path):
    folder = tmp_path / "pair"
    shutil.copytree(UNFINISHED, folder)
    world = RunWorld(folder, device=CPU)
    description = world.describe()
    assert (description["title"], description["species"]) == ("pair", ["rule-0", "rule-1"])
    assert world.counts == [128, 128]
    curve, _ = world.take_events()
    assert len(curve["points"]) > 1
    rules = [load_rule(folder / f"rule-{k}.safetensors").float() for k in (0, 1)]
    x, s, generator = world.particles.x, world.particles.s, torch.Generator()
    generator.set_state(world._generator.get_state())
    world.advance()
    with torch.no_grad():
        x, _ = rollout_species(
            rules, x, s, 1, counts=[128, 128], density_counts=[128, 128], eps=0.3,
            update_prob=0.5, generator=generator,
        )  # fmt: skip
    assert torch.equal(world.particles.x, x)
    # A newer checkpoint.
    path = folder / "rule-1.safetensors"
    metadata = {name: rule_metadata(path)[name] for name in ("task", "config")}
    save_rule(rules[0], path, metadata=metadata)
    polled(world)
    assert torch.equal(world.live_rules[1].rule.hidden.weight, rules[0].hidden.weight)
    world.handle({"type": "reset"})
    assert world.counts == [128, 128]


def test_another_run_in_the_folder_is_another_world(tmp_path, followed):
    world = followed
    world.take_events()
    advance(world, 1)
    # With another picture of the same sizes, and then in a box.
    write_run(tmp_path, "heart")
    assert polled(world)[-1]["type"] == "world"
    assert (world.task.config.target, world.step) == ("heart", 0)
    advance(world, 1)
    write_run(tmp_path, "heart", trained_on("heart"))
    polled(world)
    assert world.step == 1
    write_run(tmp_path, "dots")
    reordered, description = polled(world)
    assert reordered == {"type": "reordered"}
    assert description["box"] == [2.0, 2.0]
    advance(world, 1)
    assert world.frame().step == 1


def test_particles_carry_the_codes_of_the_newest_rule(tmp_path):
    write_run(tmp_path, "seven-pictures")
    world = RunWorld(tmp_path, device=CPU, particle_count=64)
    world.advance()
    newer = trained_on("seven-pictures")
    code = newer.codes.table[0].detach()
    assert not torch.equal(world.particles.s[0, 0, :8], code)
    rest = world.particles.s[..., 8:].clone()
    write_run(tmp_path, "seven-pictures", newer)
    polled(world)
    assert torch.equal(world.particles.s[0, :, :8], code.expand(64, 8))
    assert torch.equal(world.particles.s[..., 8:], rest)
    world.handle({"type": "reset"})
    assert torch.equal(world.particles.s[0, :, :8], code.expand(64, 8))


def test_a_log_that_begins_again_or_goes_back_is_shown_from_its_start(tmp_path, followed):
    world, path = followed, tmp_path / "log.jsonl"
    points(world)
    # A resumed run drops the lines after its checkpoint.
    JsonlLog(path).truncate(4)
    assert points(world) == [(False, [[k, 1.0 / (k + 1)] for k in range(5)])]
    # Another run, which may be written over the same place of the disk, and be longer already.
    with path.open("r+", encoding="utf-8") as file:
        file.write("".join(f'{{"iteration": {k}, "loss": 2.0}}\n' for k in range(20)))
    assert points(world) == [(False, [[k, 2.0] for k in range(20)])]
    path.unlink()
    assert points(world) == []
    log(tmp_path, 0, 1)
    assert points(world) == [(False, [[0, 1.0]])]
    # A line that is being written waits.
    with path.open("a", encoding="utf-8") as file:
        file.write('{"iteration": 10, "lo')
        file.flush()
        assert points(world) == []
        file.write('ss": 0.25}\n')
    assert points(world) == [(True, [[10, 0.25]])]


def test_a_rule_that_is_damaged_meanwhile_is_reported_and_the_world_lives_on(tmp_path, followed):
    world = followed
    world.take_events()
    (tmp_path / "rule.safetensors").write_bytes(b"half")
    (error,) = polled(world)
    assert error["type"] == "error"
    assert "cannot load a rule" in error["message"]
    assert polled(world) == []
    world.advance()
    assert world.step == 1


def test_an_unfinished_run_is_rejected(tmp_path):
    for content, folder, message in (
        (None, tmp_path, r"must hold the rule\.safetensors of a run"),
        ("{}", tmp_path, "has not written its rules yet: wait for its first"),
        ("{}", tmp_path / "none", "a run must be a folder"),
    ):
        if content is not None:
            (tmp_path / "config.json").write_text(content, encoding="utf-8")
        with pytest.raises(NPAError, match=message):
            RunWorld(folder, device=CPU)


# Environments.


def small_environment(name, **keywords):
    small = {"particle_count": 64, "resolution": 16, "disable_env_checker": True}
    return gymnasium.make(name, **small, **keywords)


def test_the_speed_of_a_step_across_an_edge_of_the_box_is_that_of_the_step():
    env = small_environment("npa/Texture-v0", target="dots")
    action = np.zeros(env.action_space.shape, np.float32)
    action[:, 0] = 1.0
    world = EnvironmentWorld(env, lambda observation: action)
    particles = world.particles
    particles.x[..., 0] = 1.0 - 1e-4
    world.particles = particles
    put(world, show="speed")
    world.advance()
    assert int((world.particles.x[..., 0] < 0).sum()) > 10
    assert 0.0 < float(world._travelled.max()) <= 1.0 + 1e-5
    world.close()


@pytest.fixture
def episodes():
    env = small_environment("npa/Morphogenesis2D-v0", max_episode_steps=3)
    world = EnvironmentWorld(env, ZeroPolicy(env), policy_name="zero")
    yield world
    world.close()


def test_episodes_follow_each_other(episodes):
    first = episodes.frame().positions.copy()
    advance(episodes, 2)
    assert episodes.frame().step == 2
    (acted,) = episodes.take_events()
    assert acted["total"] == episodes._return
    episodes.advance()
    _, curve, description = episodes.take_events()
    assert curve["name"] == "Return"
    assert curve["points"][0][0] == 1
    assert "policy zero, episode 2; the last one ended after 3 steps" in description["note"]
    assert episodes.frame().step == 0
    assert not np.array_equal(episodes.frame().positions, first)
    episodes.handle({"type": "reset", "seed": 0})
    np.testing.assert_array_equal(episodes.frame().positions, first)


def test_the_pushes_of_a_policy_and_the_outline_of_the_target_are_shown():
    env = small_environment("npa/Gardener2D-v0")
    action = np.zeros(env.action_space.shape, np.float32)
    action[:2] = 0.5, -1.0
    world = EnvironmentWorld(env, lambda observation: action)
    outline = np.array(world.describe()["outline"])
    # Closed lines: each end is also that of another line.
    ends = np.concatenate((outline[:, :2], outline[:, :2] + outline[:, 2:]))
    away = np.abs(ends[:, None] - ends).sum(-1)
    assert np.sort(away, axis=1)[:, 1].max() < 0.005
    target = world._inner.task.task.target
    for side in (np.min, np.max):
        want = side(target.points.numpy(), axis=0)
        np.testing.assert_allclose(side(ends, axis=0), want, atol=target.pixel_size)
    x, config = world.particles.x[0], world._inner.task.config
    world.advance()
    (acted,) = world.take_events()
    corner = x.mean(dim=0) - config.place_reach
    np.testing.assert_allclose(acted["middle"], x.mean(dim=0), atol=1e-5)
    np.testing.assert_allclose(acted["pushes"][0][:2], corner, atol=1e-2)
    push = config.push_length * action[:2]
    np.testing.assert_allclose(acted["pushes"][0][2:], push, atol=1e-5)
    assert acted["pushes"][-1][2:] == [0.0, 0.0]
    world.close()


def test_hands_reach_into_environments(episodes):
    before = episodes.frame().positions.copy()
    episodes.handle(brush("push", move=[0.1, 0.0], radius=0.3, strength=1.0))
    after = episodes.frame().positions
    assert (after - before)[:, 0].max() > 0.05
    episodes.handle({"type": "damage", "name": "noise"})
    assert not np.array_equal(episodes.frame().positions, after)
    particles = episodes.particles
    particles.s[..., 0] = particles.x[..., 0]
    episodes.particles = particles
    episodes.handle(brush("inject", source=[0.1, 0.0], radius=0.2, strength=1.0))
    assert not torch.equal(episodes.particles.s, particles.s)
    with pytest.raises(NPAError, match="unknown brush 'remove'"):
        episodes.handle(brush("remove"))
    put(episodes, loss=True)
    assert episodes.frame().loss == pytest.approx(episodes._info["loss"])


def test_environments_are_made_with_a_policy():
    env, policy = make_environment("npa/Morphogenesis2D-v0", "gecko", particle_count=64)
    world = EnvironmentWorld(env, policy)
    before = world.frame().positions.copy()
    put(world, show="speed")
    world.advance()
    assert not np.array_equal(world.frame().positions, before)
    world.close()
    make_environment("npa/Morphogenesis2DSmall-v0")[0].close()
    with pytest.raises(NPAError, match="env must be an environment of npa_envs"):
        EnvironmentWorld(gymnasium.make("CartPole-v1"), lambda observation: 0)
