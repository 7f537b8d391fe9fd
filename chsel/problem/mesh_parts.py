"""Parts of a mesh: separated where they touch, turned outward, and united where they overlap."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import MeshWarning
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import trimesh

_TOUCHING = 1e-6  # metres; a file of 32-bit numbers keeps no smaller gap between parts
_MERGED = 1e-7  # metres
_IN_FRONT = 1e-4  # metres in front of a face, where it is inside of other parts or not
_INWARD = -0.01  # volume per area^1.5 of open parts that look inward; 0.09 of a closed sphere
_SAME = 1e-3  # of the smallest part's area; a union takes more from parts that have more in common


def outer_surface(mesh: trimesh.Trimesh, name: str) -> tuple[trimesh.Trimesh, list[MeshWarning]]:
    """Return the outer surface of a mesh of merged vertices, metres, and what a user should know.

    A part is a set of faces that edges connect. Closed parts are turned outward, but for cavities:
    those strictly inside of material that look inward. Parts that overlap or touch are united, and
    faces inside of other parts left out. No edge of the result has more than two faces. The mesh of
    a single closed part that looks outward is returned as it is.
    """
    import trimesh

    if not mesh.is_watertight:
        mesh = _split_edges(_without_walls(mesh))
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    if labels.max() == 0 and mesh.is_watertight and mesh.is_winding_consistent:
        if mesh.volume < 0.0:
            mesh.invert()
        return mesh, []
    parts = _Parts(mesh, labels, name=name)
    parts.turn_outward()
    return parts.united(), parts.warnings


class _Parts:
    """The parts of a mesh without edges of more than two faces, which are turned and united."""

    def __init__(self, mesh: trimesh.Trimesh, labels: IntArray, *, name: str) -> None:
        """labels (F,): the part of each face."""
        self._mesh = mesh
        self._name = name
        self._labels = labels
        self._vertices = np.asarray(mesh.vertices)
        self._faces = np.array(mesh.faces)  # as turned
        self._count = int(labels.max()) + 1
        by_part = np.argsort(labels, kind="stable")
        self._rows = np.split(by_part, np.cumsum(np.bincount(labels))[:-1])
        corners = self._vertices[self._faces]  # (F, 3, 3)
        self._lower = np.full((self._count, 3), np.inf)
        self._upper = np.full((self._count, 3), -np.inf)
        np.minimum.at(self._lower, labels, corners.min(axis=1))
        np.maximum.at(self._upper, labels, corners.max(axis=1))
        self._diagonal = np.sqrt(((self._upper - self._lower) ** 2).sum(axis=1))
        self._around: dict[int, list[int]] = {}  # of cavities: the parts around them
        self._depths: dict[int, FloatArray] = {}  # distances of vertices to parts
        self.warnings: list[MeshWarning] = []

        part = labels[mesh.edges_face]
        free = _repeats(mesh.edges_sorted) == 1
        one_sided = np.bincount(part, _repeats(mesh.edges) > 1, self._count) > 0
        self._closed: BoolArray = (np.bincount(part, free, self._count) == 0) & ~one_sided
        if one_sided.any():
            text = (
                f"{name} has a one-sided part, like a Moebius strip: "
                f"{self._place(int(np.argmax(one_sided)))}; what is inside of it is arbitrary"
            )
            self.warnings.append(MeshWarning("one_sided_part", text))

        # A cone over its free edges closes an open part.
        centre = tip = mesh.bounds.mean(axis=0)
        ends = self._vertices[mesh.edges[free]]
        length = np.sqrt(((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1))
        if length.sum() > 0.0:
            tip = (ends.mean(axis=1) * length[:, None]).sum(axis=0) / length.sum()
        from_tip = corners[:, 0] - np.where(self._closed[labels, None], centre, tip)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._volume = np.bincount(labels, (from_tip * across).sum(axis=1) / 6.0, self._count)
        self._area = np.bincount(labels, 0.5 * np.sqrt((across**2).sum(axis=1)), self._count)

    def turn_outward(self) -> None:
        """Turn closed parts outward but for cavities, and open parts if they look inward."""
        closed = np.flatnonzero(self._closed)
        before = self._volume[closed]
        if before.sum() < 0.0:  # probably all are mirrored
            self._turn(closed)
        for part in closed[np.argsort(-self._diagonal[closed], kind="stable")]:
            if self._volume[part] >= 0.0:
                continue
            around = [other for other in closed if self._contains(other, part)]
            if np.sign(self._volume[around]).sum() >= 1.0:
                self._around[int(part)] = [int(k) for k in around if self._volume[k] > 0.0]
                continue
            inside = [other for other in closed if self._contains(part, other)]
            self._turn([part, *inside])  # with its cavities
        turned = closed[(before < 0.0) & (self._volume[closed] > 0.0)]
        if len(turned) > 0 and (np.sign(before) == np.sign(self._volume[closed])).any():
            largest = int(turned[np.argmax(self._diagonal[turned])])
            count = "a part" if len(turned) == 1 else f"{len(turned)} parts, the largest one"
            text = (
                f"the faces of {count} of {self._name}, {self._place(largest)}, looked inward "
                "and were turned outward"
            )
            self.warnings.append(MeshWarning("inward_part", text))
        opened = np.flatnonzero(~self._closed)
        if self._volume[opened].sum() < _INWARD * self._area[opened].sum() ** 1.5:
            self._turn(opened)
            text = f"the faces of {self._name} looked inward and were turned outward"
            self.warnings.append(MeshWarning("inward_mesh", text))

    def united(self) -> trimesh.Trimesh:
        """Return the mesh without the faces inside of it."""
        import trimesh

        bodies = {int(part): [int(part)] for part in np.flatnonzero(self._closed)}
        for cavity, around in self._around.items():
            parent = min(around, key=lambda part: self._diagonal[part])
            bodies[parent] += bodies.pop(cavity)
        kept = np.ones(len(self._faces), dtype=bool)
        unions: list[trimesh.Trimesh] = []
        hidden = False
        for group in self._groups():
            solids = [bodies[part] for part in group if part in bodies]
            if len(group) > 1 and not self._closed[group].all():
                hidden = True
            if len(solids) < 2:
                continue
            parts = [part for solid in solids for part in solid]
            union = _union([self._part_mesh(solid) for solid in solids])
            if union is None:
                hidden = True
            elif self._area[parts].sum() - union.area > _SAME * self._area[parts].min():
                kept[np.isin(self._labels, parts)] = False
                unions.append(union)
        if not (unions or hidden) and (self._faces == self._mesh.faces).all():
            return self._mesh
        rest = trimesh.Trimesh(self._vertices, self._faces[kept], process=False)
        whole: Any = trimesh.util.concatenate([rest, *unions])
        whole.remove_unreferenced_vertices()
        return _without_hidden(whole) if hidden else whole

    def _turn(self, parts: Iterable[Any]) -> None:
        for part in parts:
            rows = self._rows[part]
            self._faces[rows] = self._faces[rows, ::-1]
            self._volume[part] *= -1.0

    def _place(self, part: int) -> str:
        """Return a text of a part's position and size."""
        centre = 0.5 * (self._lower[part] + self._upper[part])
        at = ", ".join(f"{c:.3g}" for c in centre + 0.0)
        size = " x ".join(f"{side:.3g}" for side in self._upper[part] - self._lower[part])
        return f"the one of {size} m around ({at}) m"

    def _part_mesh(self, parts: list[int]) -> trimesh.Trimesh:
        """Return parts as a mesh."""
        import trimesh

        rows = np.concatenate([self._rows[part] for part in parts])
        mesh = trimesh.Trimesh(self._vertices, self._faces[rows], process=False)
        mesh.remove_unreferenced_vertices()
        return mesh

    def _contains(self, outer: Any, inner: Any) -> bool:
        """Return whether a closed part is strictly inside of another one."""
        if not (
            (self._lower[outer] < self._lower[inner] - _TOUCHING).all()
            and (self._upper[outer] > self._upper[inner] + _TOUCHING).all()
        ):
            return False
        if outer not in self._depths:  # of all vertices, as many small parts may be inside of it
            self._depths[outer] = _winding_distance(self._outward(outer), self._vertices)
        if not (self._depths[outer][self._faces[self._rows[inner]]] < -_TOUCHING).all():
            return False
        vertices = self._vertices[self._faces[self._rows[outer]].reshape(-1)]
        lower = self._lower[inner] - _TOUCHING
        upper = self._upper[inner] + _TOUCHING
        near = vertices[((vertices >= lower) & (vertices <= upper)).all(axis=1)]
        return len(near) == 0 or bool(
            (_winding_distance(self._outward(inner), near) > _TOUCHING).all()
        )

    def _outward(self, part: Any) -> trimesh.Trimesh:
        """Return a closed part as a mesh that looks outward."""
        mesh = self._part_mesh([part])
        if self._volume[part] < 0.0:
            mesh.invert()
        return mesh

    def _groups(self) -> list[list[int]]:
        """Return parts whose boxes overlap or touch."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        pairs = []
        for part in range(self._count - 1):
            rest = slice(part + 1, None)
            meets = (self._lower[rest] <= self._upper[part] + _TOUCHING).all(axis=1)
            meets &= (self._upper[rest] >= self._lower[part] - _TOUCHING).all(axis=1)
            met = np.flatnonzero(meets) + part + 1
            pairs.append(np.stack([np.full(len(met), part), met]))
        i, j = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), dtype=np.int64)
        graph = coo_array((np.ones(len(i)), (i, j)), shape=(self._count, self._count))
        _, group = connected_components(graph, directed=False)
        order = np.argsort(group, kind="stable")
        return [g.tolist() for g in np.split(order, np.cumsum(np.bincount(group))[:-1])]


def _repeats(edges: Any) -> IntArray:
    """Return the number of times that each row (E,) of edges (E, 2) is there."""
    _, row, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    repeats: IntArray = count[row.reshape(-1)]
    return repeats


def _winding_distance(mesh: trimesh.Trimesh, points: Any) -> FloatArray:
    """Return distances (N,) of points (N, 3) to a closed, outward mesh, negative inside."""
    import igl

    signed: FloatArray = igl.signed_distance(
        np.array(points, dtype=np.float64),
        np.array(mesh.vertices, dtype=np.float64),
        np.array(mesh.faces, dtype=np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_WINDING_NUMBER,
    )[0]
    return signed


def _union(solids: list[trimesh.Trimesh]) -> trimesh.Trimesh | None:
    """Return the union of closed meshes that look outward; None if one is no manifold.

    They are a micrometre larger meanwhile, as the faces of parts that touch are rounded apart.
    """
    import trimesh
    from manifold3d import Error, Manifold, Mesh64, OpType

    bodies = []
    for solid in solids:
        body = Manifold(
            Mesh64(
                vert_properties=_offset(solid, _TOUCHING),
                tri_verts=np.array(solid.faces, dtype=np.uint64),
            )
        )
        if body.status() != Error.NoError:
            return None
        bodies.append(body)
    # Vertices that are nearer to one another would be merged when the mesh is read.
    union = Manifold.batch_boolean(bodies, OpType.Add).set_tolerance(_MERGED).to_mesh64()
    vertices = np.asarray(union.vert_properties)[:, :3]
    faces = np.asarray(union.tri_verts, dtype=np.int64)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.vertices = _offset(mesh, -_TOUCHING)
    return mesh


def _offset(mesh: trimesh.Trimesh, distance: float) -> FloatArray:
    """Return vertices (V, 3), moved so that faces move by `distance` along normals, metres."""
    angles, corners = np.asarray(mesh.face_angles), np.asarray(mesh.faces)
    normals = np.zeros((len(mesh.vertices), 3))
    np.add.at(normals, corners, angles[..., None] * np.asarray(mesh.face_normals)[:, None])
    total = np.bincount(corners.reshape(-1), angles.reshape(-1), len(normals))
    # The mean normal of length c moves the faces by c^2 of its length.
    normals /= np.maximum(total, 1e-12)[:, None]
    moved: FloatArray = np.asarray(mesh.vertices) + distance * normals / np.maximum(
        (normals**2).sum(axis=1, keepdims=True), 0.1
    )
    return moved


def _without_hidden(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh without faces inside of others, by the winding number in front of them.

    A face that is only partly inside stays.
    """
    import igl

    in_front = np.asarray(mesh.triangles_center) + _IN_FRONT * np.asarray(mesh.face_normals)
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces, dtype=np.int64)
    inside = igl.fast_winding_number(vertices, faces, in_front) > 0.5
    if inside.any() and not inside.all():
        mesh.update_faces(~inside)
        mesh.remove_unreferenced_vertices()
    return mesh


def _without_walls(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with each face once, and without faces that two bodies have in common."""
    import trimesh

    key = np.sort(mesh.faces, axis=1)
    _, first, face, count = np.unique(
        key, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if len(first) == len(key):
        return mesh
    once = np.sort(first)
    several = count[face.reshape(-1)[once]] > 1
    single = trimesh.Trimesh(mesh.vertices, mesh.faces[once], process=False)
    labels = trimesh.graph.connected_component_labels(single.face_adjacency, len(once))
    faces_of_edge = _repeats(single.edges_sorted)
    owner = labels[single.edges_face]
    wall = np.bincount(labels, ~several) == 0
    wall &= np.bincount(owner, faces_of_edge == 1) == 0
    wall &= np.bincount(owner, faces_of_edge > 2) > 0
    single.update_faces(~wall[labels])
    single.remove_unreferenced_vertices()
    return single


def _split_edges(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh, cut at edges of more than two faces so that each has at most two."""
    import trimesh
    from scipy.cluster.hierarchy import DisjointSet
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.asarray(mesh.edges)  # edge 3 f + k begins at corner k of face f
    _, edge, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    if count.max() <= 2:
        return mesh
    by_edge = np.split(np.argsort(edge.reshape(-1), kind="stable"), np.cumsum(count)[:-1])
    links: list[Any] = [rows for rows in by_edge if len(rows) == 2]
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    sheets = DisjointSet(range(int(labels.max()) + 1))
    for rows in by_edge:
        if len(rows) > 2:
            links += _pairs_of(mesh, rows, labels=labels, sheets=sheets)
    first, second = np.array(links).T
    after = np.where(np.arange(len(edges)) % 3 == 2, -2, 1) + np.arange(len(edges))
    reverse = edges[first, 0] != edges[second, 0]
    begins = np.where(reverse, after[second], second)  # the corner where the first one begins
    ends = np.where(reverse, second, after[second])
    i, j = np.concatenate([first, after[first]]), np.concatenate([begins, ends])
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(len(edges), len(edges)))
    _, corner = connected_components(graph, directed=False)
    _, example = np.unique(corner, return_index=True)
    vertices = mesh.vertices[mesh.faces.reshape(-1)[example]]
    return trimesh.Trimesh(vertices, corner.reshape(-1, 3), process=False)


def _pairs_of(
    mesh: trimesh.Trimesh, rows: IntArray, *, labels: IntArray, sheets: Any
) -> list[tuple[int, int]]:
    """Return pairs of the faces around an edge, which belong to the same part.

    rows: of the edge in `mesh.edges`. Paired are faces that run through it in opposite ways, first
    those that other edges connect, then those with the least material between them.
    """
    vertices = np.asarray(mesh.vertices)
    start, end = vertices[np.sort(mesh.edges[rows[0]])]
    axis = (end - start) / np.sqrt(((end - start) ** 2).sum())
    away = vertices[mesh.faces.reshape(-1)[rows - rows % 3 + (rows + 2) % 3]] - start
    away -= (away @ axis)[:, None] * axis
    angle = np.arctan2(away @ np.cross(axis, away[0]), away @ away[0])
    forward = mesh.edges[rows, 0] < mesh.edges[rows, 1]
    label = labels[rows // 3]
    left = set(range(len(rows)))
    pairs = []
    while len(left) > 1:
        ranked = []
        for i in sorted(left):
            for j in sorted(left):
                if i < j:
                    first, last = (j, i) if forward[i] else (i, j)
                    between = (angle[last] - angle[first]) % (2.0 * np.pi)
                    if min(between, 2.0 * np.pi - between) < 1e-6:  # back to back
                        between = 4.0 * np.pi
                    together = sheets.connected(label[i], label[j])
                    ranked.append((forward[i] == forward[j], not together, between, i, j))
        i, j = min(ranked)[3:]
        sheets.merge(label[i], label[j])
        pairs.append((int(rows[i]), int(rows[j])))
        left -= {i, j}
    return pairs
