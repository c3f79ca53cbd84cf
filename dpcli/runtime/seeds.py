"""Random generators derived from one seed and keys, so results don't depend on order, workers or shards; all streams in one table.

A stream is the first key after the seed. Within one command no two things draw from the same stream with as many keys
behind it; where a sample's index comes first (`prepare`), the streams lie beyond all indices or have
another number of keys.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class PrepareStream(IntEnum):
    """Names the random streams of `dpc prepare`, beside those of the items, whose first key is their index."""

    TRACKS = 0  # points of an animal's surface that are followed
    ANIMAL_SHAPE = 1  # of a made animal
    ANIMAL_COAT = 2  # apart from its shape: another way to paint doesn't change that
    SPLIT = 5005  # which samples go to which split; key: the stratum
    OBJECT_SPLIT = 1 << 28  # which objects go to which split
    OBJECT_STUDY = 1 << 29  # poses in which an object is looked at, to find joints that move nothing
    SHAPE_PICTURES = 1 << 27  # models that a shape network learns from, in their poses; key: the round
    SHAPE_VIEWS = SHAPE_PICTURES + 1  # how they are drawn; key: the round
    MADE = 1 << 30  # a made subject (gestures) or object (articulated); key: its number


class ClassifyStream(IntEnum):
    """Names the random streams of `dpc classify`."""

    CLIPS = 1  # where an epoch's clips begin, and their order; key: the draw
    POINTS = 2  # points of a clip, and its augmentation; keys: the draw and the clip's place in it
    HELD_OUT_SAMPLES = 3  # samples for validation; key: the class
    HELD_OUT_PEOPLE = 4  # people for validation, and with one more key the order of each person's samples
    DRAW_ORDER = 5  # order of the clips of a draw that comes back; key: the epoch
    RECORDING = 6  # order of the videos of a recording made of them; key: the person


class SegmentStream(IntEnum):
    """Names the random streams of `dpc segment`."""

    FRAME_POINTS = 7001  # points of a training frame; keys: the sequence and the frame
    PAIR_ORDER = 7002  # order of an epoch's pairs; key: the epoch
    TURN = 7003  # rotation of a training batch; key: the step
    VALIDATION = 7004  # sequences for validation
    CLASSICAL = 7005  # draws of the classical methods
    FLOW_POINTS = 7006  # points whose flow is estimated
    FOUND_POINTS = 7007  # points of a frame that a method of finding parts sees; key: the frame
    FLOW_TRAINING = 7101  # training of a flow estimator; keys: 0 for its weights, 1 and the step for its pairs


class Generate4DStream(IntEnum):
    """Names the random streams of `dpc generate4d`."""

    FIRST_POINTS = 4001  # where the first Gaussians are
    FIRST_WEIGHTS = 4002  # the first weights of what is learned beside them
    STEP = 4003  # views, frames and cameras of a step; key: the step
    SHAPE_WEIGHTS = 4101  # the first weights of a shape network
    SHAPE_STEP = 4102  # pictures of a step of its training; key: the step


DRAWS_PER_STAGE = 100_000  # more epochs than a stage of training has: draws of two stages never share a number


def generator(seed: int, *keys: int) -> np.random.Generator:
    """Returns a NumPy generator for `(seed, *keys)`; the same arguments always give the same stream.

    `keys` are non-negative integers: a stream of the tables above, then such as an item's index or an epoch. 0 is a
    valid seed.

    >>> again = [generator(7, ClassifyStream.CLIPS, 3).random() for _ in range(2)]
    >>> again[0] == again[1], again[0] == generator(7, ClassifyStream.CLIPS, 4).random()
    (True, False)
    """
    # SeedSequence ignores zeros at the end: the number of keys tells (seed, 1) from (seed, 1, 0)
    return np.random.default_rng(np.random.SeedSequence([int(seed), len(keys), *map(int, keys)]))


def torch_seed(*keys: int) -> int:
    """Returns the 32 bits that torch's generators are seeded with for these keys, the seed first."""
    return int(np.random.SeedSequence(list(map(int, keys))).generate_state(1)[0])


def scikit_learn_state(seed: int) -> int:
    """Returns the `random_state` for a seed: scikit-learn takes 32 bits of it."""
    return seed % 2**32
