"""The same bits on every thread count, CPU and library, whoever watches: against golden.json."""

from functools import cache

import pytest

from chsel.cost.cost_settings import FREE_TERMS, GRADIENTS, CostSettings
from chsel.methods import OURS
from chsel.methods.chsel import ChselSettings
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.settings import PRESETS
from chsel.qd.emitters import SEARCHES
from chsel.qd.measures import MEASURES
from tests.determinism.cases import CASES
from tests.determinism.record import ENVIRONMENTS, HAS_FMA, recorded
from tests.tools.golden import differences, other_versions, read_golden

DEFAULT, *OTHERS = ENVIRONMENTS


@pytest.fixture(scope="module")
def record_of(tmp_path_factory):
    """What a setting gives, in a process of its own, each once."""
    directory = tmp_path_factory.mktemp("records")
    return cache(lambda name: recorded(ENVIRONMENTS[name], directory / f"{name}.json"))


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in OTHERS]


@pytest.mark.parametrize("name", [DEFAULT, *SLOW])
def test_every_bit_is_as_in_the_golden_file(name, record_of):
    whole = "--watch" not in ENVIRONMENTS[name][1]
    found = differences(read_golden(), record_of(name)[0], whole=whole)
    packages = other_versions()
    hint = f"golden.json was made with other packages: here {packages}\n" if packages else ""
    assert not found, f"setting {name!r}: {len(found)} cases differ\n{hint}" + "\n".join(found)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_FMA, reason="this CPU lacks AVX2 or FMA")
def test_the_settings_for_other_cpus_do_reach_the_compiler(record_of):
    """By a kernel that is compiled as no kernel of chsel is: it fuses where the CPU can."""
    usual, plain, fused = (record_of(name)[1] for name in (DEFAULT, *OTHERS[:2]))
    assert plain != usual == fused


def test_the_cases_meet_every_choice_at_least_once():
    settings = [case.build().settings for case in CASES.values()]
    searches = [made for made in settings if isinstance(made, ChselSettings)]
    every = [getattr(made, "cost", None) for made in settings]
    costs = [cost for cost in every if isinstance(cost, CostSettings)]
    met = {
        OURS: {case.method for case in CASES.values()},
        PRESETS: {case.preset for case in CASES.values()},
        tuple(SEARCHES): {made.search for made in searches},
        tuple(MEASURES): {made.archive.measure for made in searches},
        FREE_TERMS: {cost.free_term for cost in costs},
        GRADIENTS: {cost.gradient for cost in costs},
        LOOKUPS: {cost.lookup for cost in costs},
        OUTSIDE: {cost.outside for cost in costs},
    }
    assert [set(choices) - seen for choices, seen in met.items()] == [set()] * len(met)
    parity = {(made.search, made.emitter.ribs_parity) for made in searches}
    assert parity == {(search, flag) for search in SEARCHES for flag in (False, True)}
    assert {made.plane is not None for made in searches} == {True, False}
