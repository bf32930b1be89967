"""The command `npa-envs view`: what it shows, what it prints, what it rejects."""

from __future__ import annotations

import re
import sys

import pytest
import torch

from npa_envs import NPAError, load_rule, save_rule
from npa_envs.cli import main
from npa_envs.cli import view as command
from npa_envs.cli.view import ViewOptions, open_browser, world_maker
from npa_envs.web.environment_world import EnvironmentWorld
from npa_envs.web.rule_world import RuleWorld, RunWorld

pytest.importorskip("uvicorn")

from npa_envs.web import server

CPU = torch.device("cpu")


def make(what, **options):
    world = world_maker(ViewOptions(what=str(what), particle_count=64, **options), CPU)()
    world.close()
    return world


def test_a_rule_a_run_and_an_environment_are_distinguished(tmp_path):
    save_rule(load_rule("gecko"), tmp_path / "rule.safetensors")
    assert type(make("heart")) is RuleWorld
    # A folder with nothing but a rule is that rule.
    assert type(make(tmp_path)) is RuleWorld
    # Of a run of one rule, no configuration is read: it may be half written.
    (tmp_path / "config.json").write_text('{"particle_cou', encoding="utf-8")
    assert type(make(tmp_path)) is RunWorld
    assert type(make("npa/Morphogenesis2D-v0", policy="heart")) is EnvironmentWorld


def test_the_environment_and_the_policy_of_the_commands_examples_fit():
    for env, policy in re.findall(r"npa-envs view (\S+) --policy (\S+)", ViewOptions.__doc__):
        assert type(make(env, policy=policy)) is EnvironmentWorld


def test_an_environment_gets_the_keywords_that_a_rule_needs():
    keywords = ("target=dots", "eps=0.3", "eps0=0.3")
    assert type(make("npa/Texture-v0", policy="dots", keywords=keywords)) is EnvironmentWorld
    with pytest.raises(NPAError, match="must have the environment's eps0"):
        make("npa/Texture-v0", policy="dots")


def test_the_clouds_of_an_environment_are_in_the_middle_and_their_classes_are_counted():
    pytest.importorskip("sklearn")
    world = make("npa/PointClassification-v0").describe()
    assert (world["class_count"], world["centre"], world["half_width"]) == (10, [0.5, 0.5], 0.6)
    assert make("npa/Texture-v0").describe()["class_count"] == 0


def test_environments_of_ones_own_are_viewed(tmp_path, monkeypatch):
    text = "gymnasium.register('own/Spots-v0', 'npa_envs.envs.texture:TextureEnv')"
    (tmp_path / "own_envs.py").write_text(f"import gymnasium\n{text}\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    assert type(make("own_envs:own/Spots-v0")) is EnvironmentWorld


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["worm"], "unknown rule 'worm'"), (["npa/Worm-v0"], "unknown environment 'npa/Worm-v0'"),
        (["grid"], "grid is a target, and no rule for it is shipped"),
        (["no_module:Worm-v0"], "unknown environment 'no_module:Worm-v0'"),
        (["CartPole-v1"], "env must be an environment of npa_envs, got 'CartPole-v1'"),
        (["npa/Texture-v0", "--policy", "duck"], "the environment's space_dim, 2, got 3"),
        (["npa/Texture-v0", "--policy", "gecko"], "got 0.1: make the environment with the keyword eps0=0.1"),
        (["npa/Texture-v0", "--policy", "digits"], "got one of static particles"),
        (["nowhere.safetensors"], "'nowhere.safetensors': it does not exist"),
        (["gecko", "--policy", "random"], "policy is for environments"),
        (["gecko", "--keywords", "eps=0.2"], "keywords is for environments"),
        (["npa/Texture-v0", "--keywords", "eps"], "keywords must be NAME=VALUE, got 'eps'"),
        (["npa/Texture-v0", "--keywords", "epps=0.2"], "epps"),
        (["npa/Texture-v0", "--keywords", "device=cuda"], "must leave device to the command"),
        (["npa/Texture-v0", "--keywords", "policy=zero"], "say --policy zero"),
        (["npa/Texture-v0", "--keywords", "output=numpy"], "must leave output to the command"),
        (["npa/Texture-v0", "--keywords", "id=x"], "must leave id to the command"),
        (["npa/Texture-v0", "--keywords", "disable_env_checker=true"], "to the command"),
        (["npa/Texture-v0", "--keywords", "max_episode_steps=abc"],
         "max_episode_steps must be a whole number of at least 1, got 'abc'"),
        (["npa/Texture-v0", "--keywords", "max_episode_steps=0"], "at least 1, got 0"),
        (["gecko", "--threads", "0"], "threads must be in [1, 256], got 0"),
        (["gecko", "--port", "-1"], "port must be in [0, 65535], got -1"),
        (["gecko", "--device", "tpu"], "device must name a device"),
        (["gecko", "--seed", "-1"], "seed must be a whole number"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_before_anything_is_served(words, error, capsys, tmp_path):
    port = [] if "--port" in words else ["--port", "0"]
    assert main(["view", *words, "--no-browser", *port, "--out", str(tmp_path)]) == 2
    assert error in capsys.readouterr().err


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_the_link_is_printed_and_opened(host, capsys, monkeypatch, tmp_path):
    served, opened = [], []
    monkeypatch.setattr(server, "serve", lambda site, listener: served.append(site))
    monkeypatch.setattr(command, "open_browser", lambda address: opened.append(address) or False)
    words = ["view", "gecko", "--particle-count", "64", "--host", host, "--port", "0"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert opened[0] in output
    assert "no browser was found here: open the link in yours" in output
    assert main(["view", "npa/Morphogenesis2DSmall-v0", *words[2:], "--out", str(tmp_path)]) == 0
    site, of_environment = served
    # What a page of an environment drops is not learned.
    assert (site.training is None, of_environment.training is None) == (False, True)
    assert ("?token=" in opened[0]) == (host == "0.0.0.0")
    assert site.token is None or opened[0].endswith(site.token)


def test_no_browser_of_the_terminal_is_opened(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr(command.webbrowser, "open", lambda address: pytest.fail("opened"))
    assert not open_browser("http://127.0.0.1:1/")
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(command.webbrowser, "open", lambda address: True)
    assert open_browser("http://127.0.0.1:1/")
