"""Species and particles as agents: PettingZoo's own tests, seeds, and ids."""

import pettingzoo
import pytest
from crowds import TASKS, few, module_of, small
from pettingzoo.test import api_test, parallel_api_test, render_test, seed_test
from pettingzoo.test.max_cycles_test import max_cycles_test
from pettingzoo.test.seed_test import parallel_seed_test
from pettingzoo.test.state_test import state_test

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.multi import TASKS as TABLE

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:pettingzoo")

KINDS = {"species": (multispecies_v0, small), "particle": (particles_v0, few)}
"""Modules by what their agents are called, and keywords of small worlds."""

every_task = pytest.mark.parametrize("task", TASKS)
every_kind = pytest.mark.parametrize("kind", KINDS)


@every_kind
@every_task
def test_passes_the_api_tests(task, kind, capsys):
    module, keywords = KINDS[kind]
    deadly = keywords(task, deaths=((1, 3),))
    parallel_api_test(module.parallel_env(**deadly), num_cycles=8)
    api_test(module.env(**deadly), num_cycles=8)
    api_test(module.raw_env(**keywords(task)), num_cycles=8)


@every_kind
@every_task
def test_passes_the_seed_tests(task, kind):
    module, keywords = KINDS[kind]
    parallel_seed_test(lambda: module.parallel_env(**keywords(task)), num_cycles=5)
    seed_test(lambda: module.env(**keywords(task)), num_cycles=5)


@every_kind
@every_task
def test_passes_the_render_state_and_max_cycles_tests(task, kind, monkeypatch, recwarn):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    module, keywords = KINDS[kind]
    given = keywords(task)
    render_test(lambda **mode: module.env(**given, **mode))
    state_test(module.env(**given), module.parallel_env(**given), num_cycles=3)
    max_cycles_test(module_of(module, **given))


@every_kind
@pytest.mark.parametrize("api", ["parallel", "aec"])
@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo has no registry yet")
def test_the_registry_of_pettingzoo_makes_every_task(kind, api):
    module, keywords = KINDS[kind]
    assert tuple(module.ENVIRONMENTS.values()) == TASKS == tuple(TABLE)
    for name, task in module.ENVIRONMENTS.items():
        given = keywords(task)
        del given["task"]
        env = pettingzoo.make(api, name, **given)
        env.reset(seed=0)
        assert type(env.unwrapped.worlds.task) is TABLE[task]
        assert env.possible_agents == [f"{kind}_{k}" for k in range(2 if kind == "species" else 9)]
        assert pettingzoo.spec(api, name).id == name
