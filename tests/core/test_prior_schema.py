"""How voxels are packed into a stored tile."""

from dataclasses import replace

import numpy as np
import pytest

from presight_core.errors import StoreError
from presight_core.grid import Lattice
from presight_core.priors.documents import CityDocument, checked_name, decode, encode
from presight_core.priors.example import ExampleTile
from presight_core.priors.schema import (
    array_specs,
    check_batch,
    check_version,
    drive_bits,
    pack_columns,
    pack_voxels,
    unpack_columns,
    unpack_voxels,
)

LATTICE = Lattice()


def test_unpacking_undoes_packing_on_both_sides_of_zero():
    voxels = np.random.default_rng(0).integers(-1000, 1000, (500, 3))
    unpacked = unpack_voxels(pack_voxels(voxels, LATTICE), LATTICE.block_of(voxels), LATTICE)
    np.testing.assert_array_equal(unpacked, voxels)


def test_packed_voxels_of_a_block_sort_by_x_then_y_then_z():
    voxels = np.stack(np.meshgrid(*[np.arange(32), np.arange(32), np.arange(-3, 3)], indexing="ij"), -1).reshape(-1, 3)
    packed = pack_voxels(voxels, LATTICE).astype(np.int64)
    assert (np.diff(packed) > 0).all()


def test_columns_unpack_to_the_same_flags():
    flags = np.random.default_rng(0).random((3, 32, 32)) < 0.3
    np.testing.assert_array_equal(unpack_columns(pack_columns(flags)), flags)


def test_column_bit_order_is_the_documented_one():
    flags = np.zeros((1, 32, 32), np.bool_)
    flags[0, 5, 11] = True  # x 5, y 11: bit 3 of byte 1 of row 5
    assert pack_columns(flags)[0, 5, 1] == 1 << 3


def test_the_fortieth_drive_is_in_the_second_word():
    np.testing.assert_array_equal(drive_bits(39, 64), np.array([0, 1 << 7], np.uint32))


def test_example_batches_are_valid():
    example = ExampleTile()
    specs = array_specs(example.channel_count, example.drive_count, example.lattice.block_columns)
    for batch in example.batches():
        check_batch(batch, specs)


def test_unsorted_voxels_are_refused():
    example = ExampleTile()
    specs = array_specs(example.channel_count, example.drive_count, example.lattice.block_columns)
    batch = next(example.batches())
    with pytest.raises(AssertionError, match="voxels ascend"):
        check_batch(replace(batch, voxel=batch.voxel[::-1].copy()), specs)


def test_blocks_out_of_morton_order_are_refused():
    example = ExampleTile()
    specs = array_specs(example.channel_count, example.drive_count, example.lattice.block_columns)
    batch = next(example.batches())
    with pytest.raises(AssertionError, match="blocks ascend"):
        check_batch(replace(batch, block_index=batch.block_index[::-1].copy()), specs)


def test_a_newer_major_version_is_refused_and_a_newer_minor_is_not():
    check_version("1.9", "here")
    with pytest.raises(StoreError, match=r"here: format version 2\.0 is newer"):
        check_version("2.0", "here")


def test_documents_survive_encoding():
    document = CityDocument("town", Lattice((1.0, 2.0, 3.0), 0.5, 16), "space", 64)
    assert decode(encode(document.to_json()), "here", CityDocument.from_json) == document


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"format_version": "1.0"}', b'{"format_version": null}'])
def test_a_damaged_document_is_a_store_error(content: bytes):
    with pytest.raises(StoreError, match="here"):
        decode(content, "here", CityDocument.from_json)


@pytest.mark.parametrize("name", ["", "..", "../x", "a/b", ".hidden", "a b"])
def test_names_that_are_not_one_folder_are_refused(name: str):
    with pytest.raises(ValueError, match="cannot name a folder"):
        checked_name(name)
