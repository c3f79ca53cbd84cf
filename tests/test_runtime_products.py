"""Matrices are multiplied by the faster library only where it is as exact."""

from __future__ import annotations

import pytest
import torch

from dpcli.runtime import products

settings = getattr(torch.backends.mkldnn, "matmul", None)
pytestmark = pytest.mark.skipif(not hasattr(settings, "fp32_precision"), reason="torch before 2.9 has no such setting")


@pytest.fixture(autouse=True)
def as_torch_starts():
    before = settings.fp32_precision
    settings.fp32_precision = "ieee"
    products.choose_products.cache_clear()
    yield
    settings.fp32_precision = before
    products.choose_products.cache_clear()


def test_where_it_is_chosen_products_stay_float32():
    chosen = products.choose_products()
    assert settings.fp32_precision == ("bf16" if chosen else "ieee")
    for rows, inner, columns in ((5, 7, 3), (64, 64, 128), (4096, 512, 256), (1, 1024, 20)):
        left, right = torch.randn(rows, inner), torch.randn(columns, inner)
        exact = left.double() @ right.double().T
        for found in (left @ right.T, torch.nn.functional.linear(left, right)):
            assert float((found - exact).norm() / exact.norm()) < 2e-6
        assert float(products._error()) < products._CLOSE


def test_a_library_that_rounds_to_bfloat16_is_refused(monkeypatch):
    monkeypatch.setattr(products, "_wide_amd", lambda: True)
    plain = torch.Tensor.__matmul__

    def rounded(left, right):
        if settings.fp32_precision == "bf16" and left.dtype == torch.float32:
            left, right = left.bfloat16().float(), right.bfloat16().float()
        return plain(left, right)

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    assert not products.choose_products()
    assert settings.fp32_precision == "ieee"


def test_other_processors_and_older_torch_are_left_alone(monkeypatch):
    monkeypatch.setattr(products, "_wide_amd", lambda: False)
    assert not products.choose_products() and settings.fp32_precision == "ieee"
    products.choose_products.cache_clear()
    monkeypatch.setattr(products, "_wide_amd", lambda: True)
    monkeypatch.setattr(torch.backends.mkldnn, "matmul", object())
    assert not products.choose_products()
