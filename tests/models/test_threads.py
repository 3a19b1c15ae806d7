"""Test that torch and numpy use one thread in a block, and the previous number afterwards."""

import torch
from threadpoolctl import ThreadpoolController

from tacpipe.models.tensors import one_thread


def test_products_of_matrices_have_one_thread_in_the_block_and_as_many_as_before_after_it() -> None:
    libraries = ThreadpoolController().select(user_api="blas")  # their rounding depends on the number of threads
    with libraries.limit(limits=2):
        with one_thread():
            assert [library["num_threads"] for library in libraries.info()] == [1] * len(libraries) != []
        assert [library["num_threads"] for library in libraries.info()] == [2] * len(libraries)


def test_a_block_within_another_leaves_one_thread_until_the_outer_one_ends() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            with one_thread():
                pass
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
