"""Runs along z, row after row: one is found by where it ends."""

import warp as wp


@wp.func
def first_beyond(row_start: wp.array(dtype=wp.int32), high: wp.array(dtype=wp.int32), row: int, z: int):
    """Return the first run of a row that ends above z; where none does, the end of the row's runs."""
    run = row_start[row]
    last = row_start[row + 1]
    while run < last:
        middle = (run + last) / 2
        if high[middle] > z:
            last = middle
        else:
            run = middle + 1
    return run
