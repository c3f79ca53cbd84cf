"""The search for few rigid bodies that explain two frames: it proposes motions, verifies them, and keeps the best.

One motion is fitted to the whole first. Then, as long as the energy falls enough: regions that are badly explained are
moved by ICP from many starts that articulated things make likely (turned about their own edges, shifted along their
axes), every motion found is tried on the whole cloud, and the best one becomes a further body. The energy counts both
clouds' badly explained points and the borders between bodies, so that a motion is added only if it explains more than
it costs (in the spirit of PEARL, Isack and Boykov 2012).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dpcli.segment.flow import motion_proposals
from dpcli.segment.flow.icp_kernels import assign_kernel, energy_kernel
from dpcli.segment.flow.surface_icp import Surface
from dpcli.segment.rigid_motions import compose, move, move_each

_IDENTITY = np.eye(3, 4)


@dataclass(frozen=True)
class BodySearch:
    """Holds what the search may do. Lengths are in spacings of the points, or in diameters of the first cloud."""

    most: int = 6  # bodies
    scale: float = 1.25  # spacings: a residual of this counts one half
    share: float = 0.15  # of point-to-point distance in a residual, besides point to plane
    border: float = 0.3  # cost of a point whose neighbors are all in other bodies
    tear: float = 0.5  # share of it that grows with the gap between the two motions
    far: float = 0.1  # cost of a point's distance from where the first body would take it
    normal: float = 0.3  # how much patches care about the normal
    extra: float = 0.05  # cost of a point outside the first body
    gain: float = 0.02  # least fall of the energy for a further body, as a share of a point's worst
    regions: int = 8  # tried per round
    kept: int = 4  # motions kept of a region's
    patches: tuple[int, ...] = (16, 6)
    polish: tuple[float, ...] = (1.0, 0.5, 0.5)
    second_looks: int = 1
    tried: int = 16  # motions tried on the whole per round


@dataclass
class Bodies:
    """Holds bodies and their motions.

    label i64 (N): the body of each source point; motion f64 (K,3,4): x_target = R x_source + t; body 0 was found first.
    """

    label: np.ndarray
    motion: np.ndarray
    energy: float = 0.0
    cost: np.ndarray = field(default_factory=lambda: np.zeros((1, 0)))  # saturated residuals (K,N)


def find_bodies(source: np.ndarray, target: np.ndarray, search: BodySearch | None = None) -> Bodies:
    """Returns the bodies of source (N,3) and their motions onto target (M,3), from points alone.

    The clouds have a diameter of about 1, and 9 points or more.
    """
    return find_surface_bodies(Surface(source), Surface(target), search or BodySearch())


def find_surface_bodies(source: Surface, target: Surface, search: BodySearch) -> Bodies:
    """Returns what `find_bodies` does, of prepared clouds, so that a cloud compared with many is prepared once."""
    return _BodyFinder(source, target, search).run()


class _BodyFinder:
    """Searches the bodies of one pair of clouds."""

    def __init__(self, source: Surface, target: Surface, options: BodySearch) -> None:
        self.source, self.target, self.options = source, target, options
        self.points = source.points.astype(np.float64)
        spacing = max(source.spacing, 0.5 * target.spacing, 1e-4)
        self.scale, self.reach = options.scale * spacing, 2 * source.spacing + 1e-4
        tensor = np.einsum("ni,nj->nij", source.normals, source.normals).reshape(-1, 9)
        feature = np.concatenate([source.points, options.normal * tensor], 1)
        self.patches = [motion_proposals.cluster_patches(feature, count) for count in options.patches]

    def run(self) -> Bodies:
        """Returns the bodies of the whole search: grow, look at each again, prune, tighten."""
        found = self._add_bodies(self._fit_one_body())
        for _ in range(self.options.second_looks):
            if len(found.motion) > 1:
                found = self._add_bodies(self._drop_needless_bodies(self._replace_motions(found)))
        return self._tighten_motions(self._drop_needless_bodies(found))

    def _add_bodies(self, bodies: Bodies) -> Bodies:
        """Returns the bodies with further ones, as long as each lowers the energy by `gain`."""
        while len(bodies.motion) < self.options.most:
            better = self._add_best_body(bodies)
            if better is None or better.energy > bodies.energy - self.options.gain:
                break
            bodies = better
        return bodies

    def _replace_motions(self, bodies: Bodies) -> Bodies:
        """Returns the bodies with other motions for those after the first, where that lowers the energy."""
        for k in range(1, len(bodies.motion)):
            for motion in self._find_other_motions(bodies, k):
                cost, motions = bodies.cost.copy(), bodies.motion.copy()
                cost[k], motions[k] = self._measure_cost(motion), motion
                tried = self._refit_motions(self._with_energy(self._assign_points(bodies.label, cost), motions, cost))
                if tried.energy < bodies.energy:
                    bodies = tried
        return _drop_empty_bodies(bodies)

    def _improve(self, region: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns where ICP of a region's points (indices) ends from first motions (H,3,4): motions (h,3,4), the better half,
        and their mean saturated residuals (h)."""
        part = np.ascontiguousarray(self.source.columns[:, region])
        return self.target.icp_many(part, first, 12, 0.08, self.reach, self.options.share, self.scale)

    def _find_other_motions(self, bodies: Bodies, k: int) -> np.ndarray:
        """Returns motions (H,3,4) of body k's points that ICP ends at when it starts from the first body's motion."""
        region = np.flatnonzero(bodies.label == k)
        if len(region) < 8:
            return np.zeros((0, 3, 4))
        points = move(bodies.motion[0], self.points[region])
        first = compose(motion_proposals.propose_motions(points, np.zeros((0, 3))), bodies.motion[0])
        ends, score = self._improve(region, first)
        chosen = motion_proposals.choose_distinct(ends, score, self.points[region], 0.03, self.options.kept)
        return ends[[h for h in chosen if score[h] < 0.6]]

    def _drop_needless_bodies(self, bodies: Bodies) -> Bodies:
        """Returns the bodies without those whose points the others explain nearly as well."""
        while len(bodies.motion) > 1:
            fewer = [self._drop_body(bodies, k) for k in range(len(bodies.motion))]
            best = min(fewer, key=lambda tried: tried.energy)
            if best.energy > bodies.energy + self.options.gain:
                break
            bodies = best
        return bodies

    def _drop_body(self, bodies: Bodies, k: int) -> Bodies:
        """Returns the bodies without body k, whose points go to the others."""
        cost = np.delete(bodies.cost, k, 0)
        label = np.where(bodies.label == k, cost.argmin(0), bodies.label - (bodies.label > k))
        return _drop_empty_bodies(
            self._with_energy(self._assign_points(label, cost), np.delete(bodies.motion, k, 0), cost)
        )

    def _tighten_motions(self, bodies: Bodies) -> Bodies:
        """Returns the bodies with motions refitted, ever tighter, as long as the energy falls."""
        for tight in self.options.polish:
            refined = self._refit_motions(bodies, tight)
            if refined.energy < bodies.energy:
                bodies = _drop_empty_bodies(refined)
        return bodies

    def _saturate(self, squared: np.ndarray) -> np.ndarray:
        """Returns squared residuals as costs between 0 and 1; one half at `scale`."""
        return squared / (squared + self.scale**2)

    def _measure_cost(self, motion: np.ndarray) -> np.ndarray:
        """Returns the saturated residuals (N) of all source points under one motion (3,4)."""
        return self._saturate(self.target.residuals(self.source.columns, motion, self.options.share))

    def _fit_one_body(self) -> Bodies:
        """Returns one body with one motion for all points, the best of those found from a few small turns."""
        turns = motion_proposals.turn_about(np.tile(np.eye(3), (2, 1)), np.repeat([-0.2, 0.2], 3), self.points.mean(0))
        nobody = np.zeros(len(self.points), np.int64)
        ends, _ = self.target.icp_many(
            self.source.columns, np.concatenate([_IDENTITY[None], turns]), 15, 0.1, 0.03, self.options.share, self.scale
        )
        tries = [self._with_energy(nobody, motion[None], self._measure_cost(motion)[None]) for motion in ends]
        best = min(tries, key=lambda bodies: round(bodies.energy, 9))
        motion = self.target.icp(self.source.columns, best.motion[0], 20, 0.04, 0.012)
        return self._with_energy(nobody, motion[None], self._measure_cost(motion)[None])

    def _with_energy(self, label: np.ndarray, motion: np.ndarray, cost: np.ndarray) -> Bodies:
        """Returns bodies with their energy.

        It sums both clouds' mean saturated residuals, the borders, and the way from the first body.
        """
        options = self.options
        weights = (options.share, self.scale, options.tear, options.border, options.far)
        source, target = self.source, self.target
        energy = energy_kernel(
            self.points, source.normals, label, motion, cost, source.neighbors, target.columns, weights
        )
        return Bodies(label, motion, energy, cost)

    def _assign_points(self, label: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """Returns labels (N): each point goes to the body that explains it and its neighbors best (ICM)."""
        label = label.copy()
        assign_kernel(cost, self.source.neighbors, label, self.options.extra, self.options.border, 6)
        return label

    def _add_best_body(self, now: Bodies) -> Bodies | None:
        """Returns the best of all ways found to add a body, refined; None where no motion explains a region better."""
        proposals = sorted(self._propose_motions(now), key=lambda item: item[0])[: self.options.tried]
        best = None
        for _, motion, region in proposals:
            label = now.label.copy()
            label[region] = len(now.motion)
            cost = np.concatenate([now.cost, self._measure_cost(motion)[None]])
            tried = self._with_energy(
                self._assign_points(label, cost), np.concatenate([now.motion, motion[None]]), cost
            )
            if best is None or tried.energy < best.energy:
                best = tried
        if best is None:
            return None
        for _ in range(2):
            refined = self._refit_motions(best)
            if refined.energy >= best.energy:
                break
            best = refined
        return _drop_empty_bodies(best)

    def _refit_motions(self, bodies: Bodies, tight: float = 1.0) -> Bodies:
        """Returns the bodies with each motion refined by ICP on its own points; tight: factor of the residuals' scale."""
        motions = []
        for k, motion in enumerate(bodies.motion):
            own = np.ascontiguousarray(self.source.columns[:, bodies.label == k])
            few = own.shape[1] < 6
            reach = tight * self.reach
            motions.append(motion if few else self.target.icp(own, motion, 10, 1.2 * reach, 0.5 * reach))
        cost = np.stack([self._measure_cost(motion) for motion in motions])
        return self._with_energy(self._assign_points(bodies.label, cost), np.stack(motions), cost)

    def _propose_motions(self, now: Bodies) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Returns (gain, motion, region) for the best few motions of every badly explained region.

        They come from ICP of the region from every start of `motion_proposals`.
        """
        own = now.motion[now.label]
        moved = move_each(own, self.points)
        normals = np.einsum("nij,nj->ni", own[:, :, :3], self.source.normals)
        seen = self._saturate(self.target.covered_by(moved, normals, self.options.share))
        lonely = motion_proposals.find_patch_centers(self.target.points[seen > 0.5])
        current = now.cost[now.label, np.arange(len(now.label))]
        proposals = []
        for region in self._find_bad_regions(current):
            body = np.bincount(now.label[region]).argmax()
            first = compose(motion_proposals.propose_motions(moved[region], lonely), now.motion[body])
            ends, score = self._improve(region, first)
            gain = score - current[region].mean()
            for h in motion_proposals.choose_distinct(ends, gain, self.points[region], 0.03, self.options.kept):
                if gain[h] < -0.05:
                    proposals.append((gain[h] * len(region), ends[h], region))
        return proposals

    def _find_bad_regions(self, current: np.ndarray) -> list[np.ndarray]:
        """Returns regions of high cost, the worst first: connected badly explained points, and patches of two sizes."""
        around = 0.5 * current + 0.5 * current[self.source.neighbors].mean(1)
        regions = [
            r for level in (0.35, 0.55) for r in motion_proposals.find_components(around > level, self.source.neighbors)
        ]
        regions += [np.flatnonzero(patch == k) for patch in self.patches for k in range(patch.max() + 1)]
        regions = [region for region in regions if len(region) >= 8 and around[region].mean() > around.mean()]
        excess = [(around[region] - around.mean()).sum() / np.sqrt(len(region)) for region in regions]
        return [regions[i] for i in np.argsort(np.negative(excess), kind="stable")[: self.options.regions]]


def _drop_empty_bodies(bodies: Bodies) -> Bodies:
    """Returns the bodies without those that own no point."""
    used, label = np.unique(bodies.label, return_inverse=True)
    return Bodies(label.reshape(-1), bodies.motion[used], bodies.energy, bodies.cost[used])
