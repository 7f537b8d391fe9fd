"""The same bits on every thread count, CPU and library, whoever watches: against golden.json."""

from functools import cache

import numpy as np
import pytest

from chsel.cost.cost_settings import FREE_TERMS, GRADIENTS, CostSettings
from chsel.methods import OURS
from chsel.methods.chsel import ChselSettings
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.settings import PRESETS
from chsel.qd.emitters import SEARCHES
from chsel.qd.measures import MEASURES
from replay.comparing.differences import ulps
from tests.determinism.cases import CASES
from tests.determinism.comparison import condensed, differences, other_versions, read_golden
from tests.determinism.environments import ENVIRONMENTS
from tests.determinism.stages import Stages

Record = tuple[dict[str, Stages], dict[str, str]]


@pytest.fixture(scope="module")
def record_of(tmp_path_factory):
    """What a setting gives, in a process of its own, each once."""
    directory = tmp_path_factory.mktemp("records")
    return cache(lambda name: ENVIRONMENTS[name].record(directory / name.replace(" ", "_")))


OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in list(ENVIRONMENTS)[1:]]


@pytest.mark.parametrize("name", ["default", *OTHERS])
def test_every_bit_is_as_in_the_golden_file(name, record_of):
    usual, _ = record_of("default")
    record, _ = record_of(name)
    found = differences(read_golden(), record, usual)
    packages = other_versions()
    hint = f"golden.json was made with other packages: here {packages}\n" if packages else ""
    assert not found, f"setting {name!r}: {len(found)} cases differ\n{hint}" + "\n".join(found)


@pytest.mark.slow
def test_the_settings_for_other_cpus_do_reach_the_compiler(record_of):
    """By a kernel that is compiled as no kernel of chsel is: it fuses where the CPU can."""
    generic, haswell = list(ENVIRONMENTS)[1:3]
    if not ENVIRONMENTS[haswell].variables:
        pytest.skip("this CPU lacks AVX2 or FMA")
    names = ("default", generic, haswell)
    usual, plain, fused = (record_of(name)[1]["fused kernels"] for name in names)
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


def _one_bit_off(record, case, stage, part):
    stages = {**record[case], stage: {**record[case][stage]}}
    array = stages[stage][part].copy()
    array.flat[-1] = np.nextafter(array.flat[-1], np.inf)
    stages[stage][part] = array
    return {**record, case: stages}


def test_one_wrong_bit_is_found_and_said_where():
    stages = {
        "step 0: costs of E_0": {"costs": np.array([1.0, 2.0, 3.0])},
        "step 0: hypotheses": {"cost": np.array([0.5, 0.0]), "cell": np.array([3, 4])},
    }
    record = {"first": stages, "second": stages}
    golden = condensed(record)
    assert differences(golden, record, record) == []
    wrong = _one_bit_off(record, "second", "step 0: hypotheses", "cost")
    assert differences(golden, wrong, record) == [
        "second: 'step 0: hypotheses' differs, 1 of 2 cost by up to 1 ulp"
    ]
    wrong = _one_bit_off(wrong, "second", "step 0: costs of E_0", "costs")
    assert differences(golden, wrong, record) == [
        "second: 'step 0: costs of E_0' differs, 1 of 3 costs by up to 1 ulp"
    ]
    assert differences(golden, wrong, wrong) == [
        "second: 'step 0: costs of E_0' differs, by up to 1 ulp in the numbers in golden.json"
    ]
    unfinished = {
        "first": stages,
        "second": {"step 0: costs of E_0": stages["step 0: costs of E_0"]},
    }
    assert differences(golden, unfinished) == ["second: stage 'step 0: hypotheses' is missing"]
    assert differences(golden, {"first": stages}) == ["second: not recorded"]


def test_ulps_count_the_numbers_between():
    left = np.array([1.0, 0.0, -0.0, 5e-324, -1.0, 1.5])
    right = np.array([1.0 + 2.0**-51, -0.0, 5e-324, -5e-324, -1.0 - 2.0**-52, 1.5])
    assert ulps(left, right).tolist() == [2, 1, 2, 3, 1, 0]
