"""The shape network as a prior: a clip's pictures, cut out around the object, through the network, back to the camera's depths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dpcli.generate4d.shape.layers import INTERVALS, NEAREST, Camera, ShapeLayers
from dpcli.generate4d.shape.model_file import DEFAULT, load_shape_model
from dpcli.generate4d.shape.network import Encoded, ShapeNetwork, tilted_plane
from dpcli.generate4d.shape.silhouette import ball_thickness
from dpcli.generate4d.shape.training.confidence import confidence

_FILL = 0.89  # of the cut-out's side is filled by the object, as in training
_LENGTHEN, _LONGEST = 1.5, 3.0  # power of the thickness beside the inflation's; most that an object is stretched
_SURE = 1.0, 1.5  # standard deviations of the turn about the vertical and of that about the horizontal
_LONGER = 0.5  # standard deviations
_TURN_COST = 1.0  # logarithm of probability, for an object that turns by one bin from a frame to the next


@dataclass(frozen=True)
class _CutOut:
    """Holds where a square cut-out lies in its picture: top, left and side, pixels; it may reach beyond the picture."""

    top: int
    left: int
    side: int

    def window(self, height: int, width: int) -> tuple[slice, slice, slice, slice]:
        """Returns rows and columns of the picture, and rows and columns of the cut-out, that are in both."""
        top, left = max(self.top, 0), max(self.left, 0)
        bottom, right = min(self.top + self.side, height), min(self.left + self.side, width)
        own = slice(top - self.top, bottom - self.top), slice(left - self.left, right - self.left)
        return slice(top, bottom), slice(left, right), *own


class Network:
    """Predicts layers by the trained network; the far side has the colors of the near one.

    model: a weights file, a folder of `train-prior`, or the name of a shipped network. The turn of the object, and how long
    it is along the line of sight, are chosen for all frames together. The confidence says how much a frame is like the
    creatures that the network learned from, rather than a thing.
    """

    name = "network"

    def __init__(self, model: str = DEFAULT) -> None:
        self._model, notes = load_shape_model(model)
        self._size, self._confidence = int(notes["size"]), notes["confidence"]

    @torch.inference_mode()
    def layers(
        self,
        pictures: np.ndarray,  # [T, 4, H, W]
        camera: Camera,
    ) -> list[ShapeLayers]:  # T
        """Returns the layers of each frame; see `ShapePrior.layers`."""
        found = [_place(picture[3] > 0.5) for picture in pictures]
        shown = [index for index, place in enumerate(found) if place is not None]
        layers = [_empty(picture, camera) for picture in pictures]
        if not shown:
            return layers
        cut = torch.stack([_shrink(pictures[index], found[index], self._size) for index in shown])
        depth, second, sure = self._predict(cut)
        for row, index in enumerate(shown):
            layers[index] = _expand(
                depth[row], second[row], cut[row, 3], pictures[index], found[index], camera, sure[row]
            )
        return layers

    def _predict(self, cut: Tensor) -> tuple[Tensor, Tensor, list[float]]:
        """Returns depth (T,4,S,S) in sides of the cut-outs (T,5,S,S), probability of a second interval, and confidences.

        Both the pictures and their mirror images are looked at.
        """
        model, flipped = self._model, cut.flip(-1)
        own, other = model.encode(cut), model.encode(flipped)
        logits = own.angles.log_softmax(-1)
        mirrored = other.angles.log_softmax(-1)
        mirrored[:, 0] = mirrored[:, 0].flip(-1)
        angles = choose_angles(model, (logits + mirrored) / 2)
        length = choose_length(model, (own.lengths.log_softmax(-1) + other.lengths.log_softmax(-1)) / 2)
        depth, second = self._decode(own, cut, angles, length)
        opposite = angles * torch.tensor([-1.0, 1.0])
        depth2, second2 = (x.flip(-1) for x in self._decode(other, flipped, opposite, length))
        sure = confidence(((own.overall + other.overall) / 2).numpy(), self._confidence).tolist()
        depth, second = (depth + depth2) / 2, (second + second2) / 2
        if not model.config.lengths:
            depth = lengthened(depth, second, cut, tilted_plane(angles, cut.shape[-1]))
        return depth, second, sure

    def _decode(self, encoded: Encoded, cut: Tensor, angles: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        depth, second = self._model.decode(encoded, cut, angles, length)
        return depth, second.sigmoid()


def choose_angles(model: ShapeNetwork, logits: Tensor) -> Tensor:
    """Returns the mean angles (T,2) of a clip's frames, each in the light of all: logits (T,2,bins).

    Frames of a clip err alike, so that all together count as one. An angle within _SURE standard deviations of 0 becomes 0:
    a turn that isn't sure costs more, seen from the side, than one that is missed, and of something flat, such as a sign, a
    tilt costs most.
    """
    evidence = logits.log_softmax(-1) / len(logits)
    bins = torch.arange(logits.shape[-1])
    turns = -_TURN_COST * (bins[:, None] - bins).abs()
    before, after = _passed_on(evidence, turns), _passed_on(evidence.flip(0), turns).flip(0)
    share = (before + evidence + after).softmax(-1)
    mean = (share * model.centers).sum(-1)
    spread = (share * (model.centers - mean[..., None]).square()).sum(-1).sqrt()
    return torch.where(mean.abs() > torch.tensor(_SURE) * spread, mean, 0.0)


def choose_length(model: ShapeNetwork, logits: Tensor) -> Tensor:
    """Returns the logarithm of a clip's length (T), the same for all its frames, in the light of all: logits (T,bins).

    It is half a standard deviation above the mean: what is too short loses more of the silhouettes from the sides than what
    is too long.
    """
    if not logits.shape[-1]:
        return model.mean_length(logits)
    share = logits.mean(0).softmax(-1)
    mean = (share * model.length_centers).sum()
    spread = (share * (model.length_centers - mean).square()).sum().sqrt()
    return (mean + _LONGER * spread).expand(len(logits))


def lengthened(depth: Tensor, second: Tensor, cut: Tensor, plane: Tensor) -> Tensor:
    """Returns the layers (T,4,S,S) of a clip, stretched along the line of sight, away from the plane (T,1,S,S) of its turn.

    Learned from mean errors, layers take the middle of all lengths that an object may have: seen from its end, one that
    the network finds thicker than its inflation is longer yet, by about the power _LENGTHEN of how much thicker. All
    frames say together how much that is, and where its middle lies. cut: the network's pictures (T,5,S,S).
    """
    mask, rest = cut[:, 3], depth - plane
    inside = (rest[:, 1] - rest[:, 0] + (second > 0.5) * (rest[:, 3] - rest[:, 2])) * mask
    thicker = inside.sum((1, 2)) / (2 * cut[:, 4] * mask).sum((1, 2)).clamp(min=1e-6)
    stretch = float(thicker.median().clamp(1.0, _LONGEST ** (1 / _LENGTHEN))) ** _LENGTHEN
    middle = rest[:, :2].mean(1)[mask > 0].median() if mask.any() else 0.0
    return plane + middle + stretch * (rest - middle)


def _passed_on(evidence: Tensor, turns: Tensor) -> Tensor:
    """Returns what the frames before each one say about it, logits (T,2,bins): the forward half of a chain's marginals."""
    said = [torch.zeros_like(evidence[0])]
    for row in evidence[:-1]:
        said.append(torch.logsumexp((said[-1] + row)[..., :, None] + turns, -2))
    return torch.stack(said)


def _place(mask: np.ndarray) -> _CutOut | None:
    """Returns the cut-out around a silhouette (H,W), None for an empty one."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    extent = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    side = max(int(round(extent / _FILL)), 2)
    return _CutOut((rows[0] + rows[-1] + 1 - side) // 2, (columns[0] + columns[-1] + 1 - side) // 2, side)


def _shrink(picture: np.ndarray, place: _CutOut, size: int) -> Tensor:
    """Returns the network's picture (5,S,S) of a cut-out of a picture (4,H,W)."""
    rows, columns, *own = place.window(*picture.shape[1:])
    cut = np.zeros((4, place.side, place.side), np.float32)
    cut[(slice(None), *own)] = picture[:, rows, columns]
    cut[:3] *= cut[3:]
    small = functional.interpolate(
        torch.from_numpy(cut)[None], (size, size), mode="bilinear", align_corners=False, antialias=True
    )[0]
    mask = small[3] > 0.5
    color = torch.where(mask, small[:3] / small[3:].clamp(min=1e-3), 0.0)
    half = torch.from_numpy(ball_thickness(mask.numpy()) / size)
    return torch.cat([color, mask[None].float(), half[None].float()])


def _expand(
    depth: Tensor, second: Tensor, mask: Tensor, picture: np.ndarray, place: _CutOut, camera: Camera, confidence: float
) -> ShapeLayers:
    """Returns the layers of a whole picture (4,H,W) from those of its cut-out: depth (4,S,S), second and mask (S,S)."""
    weight = mask[None, None] + 1e-4  # outside the silhouette depths mean little
    stacked = torch.cat([depth, second[None]])[None]
    size = (place.side, place.side)
    grown = functional.interpolate(stacked * weight, size, mode="bilinear", align_corners=False)
    grown = grown / functional.interpolate(weight, size, mode="bilinear", align_corners=False)
    rows, columns, *own = place.window(*picture.shape[1:])
    unit = place.side * camera.distance / camera.intrinsics[0, 0]
    layers = _empty(picture, camera)
    values = grown[0].numpy()[(slice(None), *own)]
    depth = camera.distance + unit * _in_order(values[:4])
    layers.depth[:, rows, columns] = np.maximum(depth, NEAREST * camera.distance)
    layers.presence[1, rows, columns] = values[4] * picture[3, rows, columns]
    return replace(layers, confidence=confidence)


def _in_order(depth: np.ndarray) -> np.ndarray:
    """Returns layers (4,H,W) none of which lies before the one in front of it."""
    return np.maximum.accumulate(depth, axis=0)


def _empty(picture: np.ndarray, camera: Camera) -> ShapeLayers:
    """Returns the layers of a picture (4,H,W) of whose shape nothing is known: flat, at the distance of the origin."""
    presence = np.zeros((INTERVALS, *picture.shape[1:]), np.float32)
    presence[0] = picture[3]
    color = np.broadcast_to(picture[:3], (2 * INTERVALS, *picture[:3].shape)).astype(np.float32)
    return ShapeLayers(np.full((2 * INTERVALS, *picture.shape[1:]), camera.distance, np.float32), presence, color, 0.0)
