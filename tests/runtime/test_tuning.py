"""Matrices are multiplied by the faster library only where it is as exact."""

from __future__ import annotations

import pytest
import torch

from dpcli.runtime import tuning as products


@pytest.fixture(autouse=True)
def as_torch_starts():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    products.choose_products.cache_clear()
    yield
    torch.set_float32_matmul_precision(before)
    products.choose_products.cache_clear()


def test_where_it_is_chosen_products_stay_float32():
    chosen = products.choose_products()
    assert torch.get_float32_matmul_precision() == ("medium" if chosen else "highest")
    for rows, inner, columns in ((5, 7, 3), (64, 64, 128), (4096, 512, 256), (1, 1024, 20)):
        left, right = torch.randn(rows, inner), torch.randn(columns, inner)
        exact = left.double() @ right.double().T
        for found in (left @ right.T, torch.nn.functional.linear(left, right)):
            assert float((found - exact).norm() / exact.norm()) < 2e-6
        assert products._error() < products._CLOSE


def test_a_library_that_rounds_to_bfloat16_is_refused(monkeypatch):
    monkeypatch.setattr(products, "_wide_amd", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    plain = torch.Tensor.__matmul__

    def rounded(left, right):
        if torch.get_float32_matmul_precision() == "medium" and left.dtype == torch.float32:
            left, right = left.bfloat16().float(), right.bfloat16().float()
        return plain(left, right)

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    assert not products.choose_products()
    assert torch.get_float32_matmul_precision() == "highest"


@pytest.mark.parametrize(("amd", "gpu"), [(False, False), (True, True)])
def test_other_processors_and_machines_with_a_gpu_are_left_alone(monkeypatch, amd, gpu):
    monkeypatch.setattr(products, "_wide_amd", lambda: amd)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert not products.choose_products() and torch.get_float32_matmul_precision() == "highest"
