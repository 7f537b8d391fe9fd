"""Both methods on the Medial Constraint cost: what they add to CMA-ES, and what they report."""

from __future__ import annotations

from dataclasses import replace

from chsel.methods import preset_settings
from chsel.methods.medial_constraint import (
    CmaEsSettings,
    MedialConstraint,
    MedialConstraintCmaMe,
)
from tests.chsel.methods.scene import Watcher, posed


def plain(generations: int) -> MedialConstraint:
    cma_es = CmaEsSettings(generations=generations)
    return MedialConstraint(replace(preset_settings("medial_constraint"), cma_es=cma_es))


def test_a_run_from_every_start_is_traced_to_its_end() -> None:
    method, watcher = plain(120), Watcher(snapshot_interval=5)
    method.register(posed(method), watcher)
    shown = [(stage, n, vectors.shape, len(cost)) for stage, n, vectors, cost in watcher.traces]
    assert shown == [("cma_es", done, (30, 9), 30) for done in (0, 50, 100, 120)]
    assert watcher.progressed == [("cma_es", done, 120) for done in (50, 100, 120)]
    assert watcher.archives == []


def test_the_search_only_lowers_the_best_cost_of_cma_es() -> None:
    settings = preset_settings("medial_constraint_cma_me")
    method = MedialConstraintCmaMe(
        replace(settings, cma_es=replace(settings.cma_es, generations=12))
    )
    problem = posed(method)
    before = plain(12).register(problem).cost[0]
    assert method.register(problem).cost[0] <= before * (1.0 + 1e-9)
