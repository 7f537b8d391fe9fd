"""CMA-ME on the Medial Constraint cost."""

from __future__ import annotations

from chsel.archive import GridArchive
from chsel.arrays import FloatArray
from chsel.emitters import ArchiveWatch, Draws, EmitterSettings
from chsel.kernels import medial_search as kernels
from chsel.kernels.emitters import me_search
from chsel.medial_cost import MedialObjective


def medial_cma_me(
    objective: MedialObjective,
    archive: GridArchive,
    start: FloatArray,
    count: int,
    settings: EmitterSettings,
    draws: Draws,
    watch: ArchiveWatch,
) -> None:
    """Fill the archive as chsel.emitters.cma_me does: start (d,), count samples an iteration."""
    total, dimension = settings.iterations, len(start)
    normals, elites = draws.blocks(total, count, dimension), draws.elites(total)
    size = draws.block(count, dimension)
    search = me_search(
        start,
        archive.measure.count,
        count,
        sigma0=settings.sigma0,
        ribs_parity=settings.ribs_parity,
    )
    problem = objective.model, objective.space_arrays, archive.measure.code, objective.work()
    for first, last in watch.segments(total):
        if first % size == 0:
            drawn, uniform = next(normals), elites[first : first + size]
        place = first % size, last - first // size * size
        kernels.medial_cma_me(*problem, archive.cells, search, drawn, uniform, *place)
        watch.after(last, total, archive)
