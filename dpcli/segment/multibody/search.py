"""The search for the bodies of a sequence: greedy growth by what a body explains, pruning, growth anew, splits, and refits."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dpcli.segment.multibody.explanation import Body, Explanation, body_of, label_points, refit, without_empty
from dpcli.segment.multibody.frames import Frames, Trajectory
from dpcli.segment.multibody.hypotheses import Hypothesis, find_hypotheses
from dpcli.segment.multibody.joint_motions import simplify_motions
from dpcli.segment.multibody.least_turn import turn_least
from dpcli.segment.multibody.point_fit import NUMBER_PRICE
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.multibody.splits import split_bodies
from dpcli.segment.multibody.viewpoint import find_camera
from dpcli.segment.rigid_motions import bring_to_rest
from dpcli.segment.thinning import spread_places

_TRIED = 4  # bodies fitted and tried on the whole per round
_GAIN = 1e-5  # of the energy for which a body that was taken out stays out
_SPLIT_GAIN = 1e-4  # of the energy, for which a round of splits is kept
_SHOWN = 0.6  # share of the matches in other frames of a body's points that are its own points, at least
_SPANS = 7  # of a sequence, between whose ends motion is looked for that nearer frames don't show
_WORSE = 0.02  # cost of a point between distant frames, more than between near ones, that shows such motion
_TURNED = 0.5  # radians by which a body turns that shows one camera other sides
_FITS = ((False, 1.0), (True, 0.7), (True, 0.4))  # onto own points only, residual in spacings


def explain_sequence(
    clouds: list[np.ndarray],
    settings: MultibodySettings,
    origin: np.ndarray | tuple[float, float, float] = (0, 0, 0),
    threads: int = 1,
) -> Explanation:
    """Returns the one explanation of all frames (n_t,3) f32, each of 9 points or more, of a sequence of diameter about 1.

    origin (3): of the coordinates in which the frames were recorded. If one camera saw them, from there or elsewhere, points
    that it can't see need no match. threads: in which what is tried is judged side by side; they change no result.
    """
    frames = Frames(clouds)
    if len(clouds) == 2:
        settings = replace(settings, body_price=max(settings.body_price, _least_price(frames)))
    with ThreadPoolExecutor(threads) as pool:
        hypotheses = find_hypotheses(frames, pool.map)
        search = Search(frames, settings, hypotheses, pool.map)
        found = search.begin()
        camera = find_camera(frames, found, np.asarray(origin, np.float64))
        if camera is not None:
            search = Search(frames.seen_by(camera), settings, hypotheses, pool.map)
            found = search.begin()
        found = search.settled(search.improve(found))
        return _by_distant_frames(
            search, found, lambda chosen: explain_sequence([clouds[t] for t in chosen], settings, origin, threads)
        )


def _by_distant_frames(search: Search, found: Explanation, explain: Callable[[np.ndarray], Explanation]) -> Explanation:
    """Returns the explanation, or a better one where distant frames show motion too slow for those that were compared.

    explain: explains some frames alone. A few spread over the sequence then propose bodies, which are tried beside those found.
    """
    count = len(search.frames)
    stride = count // _SPANS
    if stride < 2:
        return found
    far, known = search.between_distant(found, stride)
    one_camera = search.frames.depth_maps is not None
    if _own_cost(known) < _own_cost(found) + _WORSE or (one_camera and _shows_other_sides(known)):
        return found
    chosen = spread_places(count, _SPANS + 1)
    center = search.frames.points[search.frames.slice(0)].mean(0)
    slow = [fill_in(body.trajectory, chosen, count, center) for body in explain(chosen).bodies]
    far.pool += [*known.bodies, *(body_of(far.frames, trajectory) for trajectory in slow)]
    better = far.settled(far.tighten(far.begin()))
    return better if better.energy < known.energy else found


def _least_price(frames: Frames) -> float:
    """Returns the least price of a body between two frames, as a share of all points: the six numbers of its motion.

    There one other frame judges every point, and many small bodies fit it by chance. More frames even that out.
    """
    return 6 * NUMBER_PRICE / len(frames.points)


def fill_in(trajectory: Trajectory, known: np.ndarray, frames: int, center: np.ndarray) -> Trajectory:
    """Returns a trajectory through all frames from one (M,3,4) through the frames `known` (M), the first and last among them.

    In between, the body turns evenly and takes a point evenly along: the one that lies at `center` (3) in the first frame.
    """
    turns = Slerp(known, Rotation.from_matrix(trajectory[:, :, :3]))(np.arange(frames)).as_matrix()
    rest = bring_to_rest(center, trajectory[0])
    places = trajectory[:, :, :3] @ rest + trajectory[:, :, 3]
    place = np.stack([np.interp(np.arange(frames), known, row) for row in places.T], 1)
    return np.concatenate([turns, (place - turns @ rest)[:, :, None]], 2)


def _shows_other_sides(found: Explanation) -> bool:
    """Returns whether the largest body turns so far between frames that are compared that one camera sees other sides of it."""
    traces = np.trace(found.bodies[0].motions[..., :3], axis1=-2, axis2=-1)
    return bool(traces.min() < 1 + 2 * np.cos(_TURNED))


def _own_cost(found: Explanation) -> float:
    """Returns the mean cost of the points under their own bodies."""
    return float(found.cost[np.arange(len(found.label)), found.label].mean())


class Search:
    """Searches the explanation of one sequence; `map_` judges what is tried, one after the other or side by side."""

    def __init__(
        self, frames: Frames, settings: MultibodySettings, hypotheses: list[Hypothesis], map_: Callable = map
    ) -> None:
        self.frames, self.settings, self.map = frames, settings, map_
        self.pool = list(map_(lambda one: body_of(frames, one.trajectory), hypotheses))

    def begin(self) -> Explanation:
        """Returns a first explanation: grown, and pruned."""
        return self._prune(self._grow(self._first()))

    def improve(self, found: Explanation) -> Explanation:
        """Returns the explanation after growth without each body in turn and splits, its motions tightened."""
        for _ in range(self.settings.regrow):
            better = self._regrow(found)
            if better is found:
                break
            found = better
        return self.tighten(self._split(found))

    def settled(self, found: Explanation) -> Explanation:
        """Returns the explanation with motions that turn least and are no more general than needed, judged anew."""
        return self.judged_anew(simplify_motions(self.frames, turn_least(self.frames, found)))

    def between_distant(self, found: Explanation, stride: int) -> tuple[Search, Explanation]:
        """Returns a search of the explanation's bodies in which frames `stride` apart are compared, and its explanation by them.

        Their motions are fitted anew, since what many near frames show together drifts.
        """
        far = Search(self.frames.apart(stride), self.settings, [], self.map)
        bodies = [body_of(far.frames, body.trajectory) for body in found.bodies]
        far.pool = bodies
        return far, far.tighten(far._fitted(label_points(far.frames, bodies, self.settings, found.label)))

    def _split(self, found: Explanation) -> Explanation:
        """Returns the explanation after growth with motions of its bodies' patches, as long as the energy falls."""
        first = self.pool
        for _ in range(self.settings.regrow):
            self.pool = split_bodies(self.frames, found, self.map)
            better = self._prune(self._grow(found))
            if better.energy > found.energy - _SPLIT_GAIN:
                break
            self.pool = [*first, *found.bodies, *self.pool]
            found = self._regrow(better)
        self.pool = first
        return found

    def judged_anew(self, found: Explanation) -> Explanation:
        """Returns the explanation with labels by its bodies' motions as they now are, and without needless bodies."""
        return self._shown(
            self._prune(self._clean(label_points(self.frames, found.bodies, self.settings, found.label)))
        )

    def _first(self) -> Explanation:
        """Returns the explanation by the one body that explains most."""
        best = min(self.pool, key=lambda body: float(body.cost.mean()))
        return self._fitted(label_points(self.frames, [best], self.settings))

    def _fitted(self, found: Explanation) -> Explanation:
        """Returns the explanation with motions refitted to whole frames, if that costs less."""
        fitted = refit(self.frames, found, self.settings, *_FITS[0])
        return self._clean(fitted if fitted.energy < found.energy else found)

    def _clean(self, found: Explanation) -> Explanation:
        return without_empty(self.frames, found, self.settings)

    def _grow(self, found: Explanation) -> Explanation:
        """Returns the explanation with further bodies, as long as the energy falls."""
        while len(found.bodies) < self.settings.max_bodies:
            tried = list(self.map(partial(self._with, found), self._most_promising(found)))
            if not tried:
                break
            best = min(tried, key=lambda one: one.energy)
            if best.energy >= found.energy - 1e-6:
                break
            found = best
        return found

    def _with(self, found: Explanation, body: Body) -> Explanation:
        """Returns the explanation with a further body, fitted: a motion that is a spacing off explains a small part badly."""
        return self._fitted(label_points(self.frames, [*found.bodies, body], self.settings))

    def _most_promising(self, found: Explanation) -> list[Body]:
        """Returns the bodies by which connected points would save most, the best first."""
        current = found.cost[np.arange(len(found.label)), found.label]
        main, price = found.bodies[0].motions, self.settings.displacement
        saved = [self.frames.gain(current, body.cost, body.motions, main, price) for body in self.pool]
        order = np.argsort(np.negative(saved), kind="stable")[:_TRIED]
        return [self.pool[h] for h in order if saved[h] > 0]

    def _prune(self, found: Explanation) -> Explanation:
        """Returns the explanation without bodies that cost more than they save, the most needless one first."""
        while len(found.bodies) > 1:
            fewer = self.map(partial(self._without, found), range(len(found.bodies)))
            best = min(fewer, key=lambda one: one.energy)
            if best.energy > found.energy:
                break
            found = self._clean(best)
        return found

    def _shown(self, found: Explanation) -> Explanation:
        """Returns the explanation without bodies that other frames don't show, the least shown one first.

        What one frame alone sees of a surface has no match in the others, and any motion that brings it near other points
        explains it better than its own.
        """
        while len(found.bodies) > 1:
            shown = [
                (found.label[body.nearest[found.label == k]] == k).mean()
                for k, body in enumerate(found.bodies[1:], start=1)
            ]
            if min(shown) >= _SHOWN:
                break
            found = self._clean(self._without(found, int(np.argmin(shown)) + 1))
        return found

    def _without(self, found: Explanation, k: int) -> Explanation:
        """Returns the explanation without body k, whose points go to those that explain them best."""
        rest = [body for j, body in enumerate(found.bodies) if j != k]
        cost = np.delete(found.cost, k, 1)
        start = np.where(found.label == k, cost.argmin(1), found.label - (found.label > k))
        return label_points(self.frames, rest, self.settings, start)

    def _regrow(self, found: Explanation) -> Explanation:
        """Returns the best of what grows when a body is taken out, each in turn; itself where nothing is better."""
        best = found
        for k in range(len(found.bodies) if len(found.bodies) > 1 else 0):
            grown = self._prune(self._grow(self._clean(self._without(found, k))))
            if grown.energy < best.energy - _GAIN:
                best = grown
        return best

    def tighten(self, found: Explanation) -> Explanation:
        """Returns the explanation with motions fitted ever tighter, onto the bodies' own points, where it costs less."""
        for own, tight in _FITS[1:]:
            fitted = refit(self.frames, found, self.settings, own, tight)
            found = fitted if fitted.energy < found.energy else found
        return self._clean(found)
