"""How many devices a run takes, and how they are spread over its seeds and members."""

import math
from collections.abc import Callable

MEMBER_WORK = 4  # of a member's updates, in fits of a model: about what hopper at the paper's size takes
LEAST_PART = 32  # rows of a minibatch, below which its gradients take no longer than to average them


def shape(lanes: int, models: int, members: int, most: int, copies: Callable[[int], int]) -> tuple[int, int]:
    """Devices over seeds and over members, up to `most` together: such that the busiest has least to do, and no more of
    them than that takes.

    Args:
        lanes: S, which the devices over seeds must divide.
        models, members: N and N·M, which a device has whole numbers of; padded, where it does not divide.
        copies: how many of so many devices would share a member.
    """

    def work(seeds: int, shards: int) -> float:
        of_members = -(-members * copies(shards) // shards) / copies(shards)
        return lanes // seeds * (-(-models // shards) + MEMBER_WORK * of_members)

    shapes = [(s, m) for s in range(1, most + 1) if lanes % s == 0 for m in range(1, most // s + 1)]
    return min(shapes, key=lambda shape: (work(*shape), math.prod(shape), shape[1]))


def copies(members: int, batch: int, shards: int) -> int:
    """How many of the `shards` devices share a member: all that there are to each, if they can cut its minibatches of
    `batch` rows into equal parts that are worth it."""
    shared = shards // members
    return shared if shards == members * shared and batch % shared == 0 and batch // shared >= LEAST_PART else 1
