"""The networks' sizes at the scales `cpu` (144 points, minutes on two cores) and `toy` (seconds; results mean nothing)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from cmig_jax.config import ModelFlags
from cmig_jax.models.cmignet.flags import CMIGNetFlags, ImageFlags, PointsFlags
from cmig_jax.models.dcp.flags import DCPFlags
from cmig_jax.models.finet.flags import FINetFlags
from cmig_jax.models.idam.flags import IDAMFlags
from cmig_jax.models.masknet.flags import MaskNetFlags
from cmig_jax.models.omnet.flags import OMNetFlags
from cmig_jax.models.patches.flags import PatchFlags
from cmig_jax.models.pcrnet.flags import PCRNetFlags
from cmig_jax.models.pointnetlk.flags import PointNetLKFlags
from cmig_jax.models.prnet.flags import PRNetFlags
from cmig_jax.models.rpmnet.flags import RPMNetFlags

Resize = Callable[[Any], ModelFlags]


def cpu_size(flags: ModelFlags) -> ModelFlags:
    """Return the flags of a network of the same kind for 144 points."""
    return CPU[type(flags)](flags)


def toy_size(flags: ModelFlags) -> ModelFlags:
    """Return the flags of a network of the same kind for 24 points."""
    return TOY[type(flags)](flags)


def _cmignet(
    flags: CMIGNetFlags, points: PointsFlags, image: ImageFlags, feed_forward: int, count: int, test_count: int, **matching: Any
) -> CMIGNetFlags:
    return replace(
        flags,
        points=points,
        image=image,
        fusion=replace(flags.fusion, feed_forward=feed_forward),
        keypoints=replace(flags.keypoints, count=count, test_count=test_count if flags.keypoints.test_count else 0),
        matching=replace(flags.matching, **matching),
    )


def _cpu_cmignet(flags: CMIGNetFlags) -> CMIGNetFlags:
    points = replace(flags.points, k=12, widths=(32, 32, 64, 64), dim=128)
    image = ImageFlags(widths=(16, 32, 64, 128), blocks=(1, 1, 1, 1))
    return _cmignet(flags, points, image, 256, 48, 144, feature_widths=(64, 32, 32))


def _toy_cmignet(flags: CMIGNetFlags) -> CMIGNetFlags:
    points = replace(flags.points, k=4, widths=(4, 4), dim=8, local_widths=(8,))
    image = ImageFlags(widths=(4, 8), blocks=(1, 1))
    small = _cmignet(flags, points, image, 8, 8, 24, feature_widths=(4, 4), coordinate_widths=(4,))
    return replace(small, fusion=replace(small.fusion, heads=2))


CPU: dict[type[ModelFlags], Resize] = {
    CMIGNetFlags: _cpu_cmignet,
    DCPFlags: lambda flags: replace(flags, k=12, widths=(32, 32, 64, 64), dim=128, feed_forward=256),
    FINetFlags: lambda flags: replace(
        flags, encoder_widths=(32, 32, 64, 64, 128), fusion_widths=(512, 256, 256), regression_widths=(256, 128, 64)
    ),
    IDAMFlags: lambda flags: flags,
    MaskNetFlags: lambda flags: replace(flags, widths=(32, 32, 32, 64, 256), mask_widths=(256, 128, 64, 32)),
    OMNetFlags: lambda flags: replace(
        flags,
        local_widths=(32, 32),
        global_widths=(32, 64, 256),
        fusion_widths=(256, 256, 128),
        decoder_widths=(128, 64, 64),
        regression_widths=(256, 128, 64),
    ),
    PatchFlags: lambda flags: replace(flags, test_patches=144),
    PCRNetFlags: lambda flags: replace(flags, widths=(32, 32, 32, 64, 256), head_widths=(256, 256, 128, 128, 64)),
    PointNetLKFlags: lambda flags: replace(
        flags, widths=(*(w // 2 for w in (64, 64, 64, 128)[-len(flags.widths) + 1 :]), 256), training_points=min(flags.training_points, 72)
    ),
    PRNetFlags: lambda flags: replace(flags, k=12, widths=(32, 32, 64, 64), dim=128, feed_forward=256, keypoints=96),
    RPMNetFlags: lambda flags: replace(flags, neighbours=32, dim=64, parameter_widths=(32, 32, 32, 64, 256), parameter_head=(128, 64)),
}

TOY: dict[type[ModelFlags], Resize] = {
    CMIGNetFlags: _toy_cmignet,
    DCPFlags: lambda flags: replace(flags, k=4, widths=(4, 4), dim=8, heads=2, feed_forward=8),
    FINetFlags: lambda flags: replace(flags, encoder_widths=(4, 4, 4, 4, 4), fusion_widths=(8, 4), regression_widths=(8,)),
    IDAMFlags: lambda flags: replace(
        flags, k=4, layers=2, dim=8, significance_widths=(8,), pair_width=8, points_per_keypoint=3, iterations=2
    ),
    MaskNetFlags: lambda flags: replace(flags, widths=(4, 8), mask_widths=(8, 4), icp_iterations=2),
    OMNetFlags: lambda flags: replace(
        flags, local_widths=(4,), global_widths=(4, 8), fusion_widths=(8,), decoder_widths=(4, 4, 4), regression_widths=(8,)
    ),
    PatchFlags: lambda flags: replace(
        flags, k=4, patch_widths=(4, 4), dim=8, layers=1, heads=2, feed_forward=8, patches=12, test_patches=24, passes=2
    ),
    PCRNetFlags: lambda flags: replace(flags, widths=(4, 8), head_widths=(8, 4), iterations=2),
    PointNetLKFlags: lambda flags: replace(
        flags, widths=(4, 16), training_points=min(flags.training_points, 12), iterations=2, test_iterations=2
    ),
    PRNetFlags: lambda flags: replace(flags, k=4, widths=(4, 4), dim=8, heads=2, feed_forward=8, keypoints=12),
    RPMNetFlags: lambda flags: replace(flags, neighbours=4, dim=8, parameter_widths=(8, 16), parameter_head=(16,), test_iterations=2),
}
