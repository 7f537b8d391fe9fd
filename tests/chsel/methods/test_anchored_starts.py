from dataclasses import replace

import numpy as np
import pytest

from chsel import KnownPoints
from chsel.methods import build_method, preset_settings
from chsel.methods.anchor_sampling import AnchoredStarts, anchored_starts
from chsel.methods.chsel import Chsel
from chsel.problem.poses import apply, compose, inverse
from chsel.problem.search_space import search_space
from chsel.problem.surface import has_surface
from tests.chsel.methods.scene import BOX, BOX_GRID, WORKSPACE, Watcher, box_problem, contacts_on

FAR = inverse(compose(np.tile(np.eye(3), (5, 1, 1)), np.tile([0.5, 0.4, 0.0], (5, 1))))
STARTS = AnchoredStarts(samples=3000, kept=8)


def posed(points=None, sdf=BOX_GRID):
    """A box touched on all sides, of which E_0 (5, 4, 4) knows nothing."""
    points = points or KnownPoints(known=contacts_on(BOX, 40))
    return replace(box_problem(points), sdf=sdf, initial_set=FAR)


def starts_of(problem):
    return anchored_starts(problem, search_space(None, problem.sdf), STARTS, 0).matrices


def test_starts_are_nearer_to_the_contacts_than_e_0():
    problem = posed()
    starts = starts_of(problem)
    assert starts.shape == (8, 4, 4)
    known = problem.points.known
    away = [np.abs(BOX_GRID.at(apply(pose, known))[0]).mean() for pose in starts]
    assert max(away) < 0.03
    before = [np.abs(BOX_GRID.at(apply(pose, known))[0]).mean() for pose in FAR]
    assert min(before) > 0.2


def test_without_contacts_starts_are_anywhere_in_the_workspace():
    free = np.stack(np.meshgrid(*[np.arange(0.025, 0.2, 0.05)] * 3), axis=-1).reshape(-1, 3)
    position = inverse(starts_of(posed(KnownPoints(free=free))))[:, :3, 3]
    assert (position > np.array(WORKSPACE.lower) - 0.15).all()
    assert (position < np.array(WORKSPACE.upper) + 0.15).all()
    assert position.std(axis=0).min() > 0.1


def test_there_are_none_of_an_object_without_a_surface():
    thin = replace(BOX_GRID, values=np.abs(BOX_GRID.values) + 0.01)
    assert has_surface(BOX_GRID)
    assert not has_surface(thin)
    assert starts_of(posed(sdf=thin)).shape == (0, 4, 4)
    assert len(build_method("chsel").register(posed(sdf=thin)).cost) == 5


@pytest.mark.parametrize("name", ["chsel", "chsel_cma_me"])
def test_default_finds_what_e_0_is_too_far_from(name):
    settings = preset_settings(name)
    assert settings.starts is not None
    quick = replace(settings, emitter=replace(settings.emitter, iterations=5))
    observer, problem = Watcher(), posed()
    found = Chsel(replace(quick, starts=STARTS)).register(problem, observer)
    firsts = [trace for trace in observer.traces if trace[:2] == ("descent", 0)]
    assert [len(first.vectors) for first in firsts] == [5 + 8]
    assert len(found.cost) == len(FAR)
    alone = Chsel(replace(quick, starts=None)).register(problem)
    assert found.cost[0] < 0.5 * alone.cost[0]
