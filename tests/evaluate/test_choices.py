"""The words that options take are those that the code behind them knows."""

from __future__ import annotations

import subprocess
import sys

import pytest

from dpcli.errors import UsageError
from dpcli.evaluate import choices
from dpcli.evaluate.classification.metrics import TOP_K, ClassificationMetrics
from dpcli.evaluate.networks.lpips import NETS
from dpcli.evaluate.segmentation.metrics import SegmentationMetrics
from dpcli.evaluate.segmentation.motion_metrics import MAIN_TAU
from dpcli.evaluate.video.frechet.variants import VARIANTS
from dpcli.evaluate.video.learned import base
from dpcli.evaluate.video.picture_statistics import PictureMetrics
from dpcli.evaluate.video.protocol import PROTOCOLS


def test_every_word_is_known_to_the_code() -> None:
    assert choices.VIDEO_PROTOCOLS == tuple(PROTOCOLS)
    assert set(choices.PARTS_PROTOCOLS) == set(MAIN_TAU)
    assert choices.LEARNED_METRICS == tuple(base.TITLES)
    assert set(choices.LPIPS_NETWORKS) == set(NETS)
    assert set(choices.FVD_VARIANTS) == {name for name, variant in VARIANTS.items() if variant.metric == "fvd"}
    assert set(choices.FRECHET_METRICS) == {variant.metric for variant in VARIANTS.values()}
    assert set(choices.PICTURE_METRICS) <= set(PictureMetrics.__annotations__)
    assert set(choices.SEGMENTATION_METRICS) <= set(SegmentationMetrics.__annotations__)
    named = {f"top{TOP_K}_accuracy": "top_accuracy"}
    assert {named.get(name, name) for name in choices.CLASSIFICATION_METRICS} <= set(
        ClassificationMetrics.__annotations__
    )


def test_names_of_metrics() -> None:
    assert choices.parse_metrics(None) is None and choices.parse_video_metrics(None) is None
    assert choices.parse_metrics(" miou, ap,miou") == ("miou", "ap")
    assert choices.parse_video_metrics("ms_ssim,psnr") == ("psnr", "ms_ssim")
    for parse, text in ((choices.parse_metrics, " ,"), (choices.parse_video_metrics, "psnr,sharpness")):
        with pytest.raises(UsageError, match="--metrics"):
            parse(text)


def test_the_words_load_without_numpy() -> None:
    code = "import sys, dpcli.evaluate.choices; print(*sorted({'numpy', 'torch', 'h5py'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == ""
