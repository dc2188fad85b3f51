"""Rows of the learned methods that the paper compares with, and the figures that it prints for them (Tables 1 to 5)."""

from __future__ import annotations

from cmig_jax.experiments.schema import Flags, Quoted, Row

PROTOCOL: Flags = {
    "data.points": 1024,
    "data.sampling": "once",
    "data.keep": 0.75,
    "data.crop": "shared",
    "data.noise_std": 0.01,
    "data.noise": "fixed",
    "data.noise_clip": 0.05,
    "data.pose": "euler",
    "data.pose_of": "each-pair",
    "data.max_angle_deg": 45.0,
    "data.turn": "positive",
    "data.max_translation": 0.5,
    "data.exclude": (),
    "data.categories": "all",
    "data.test_categories": "all",
}
"""The paper's protocol (Sec. IV-A, IV-B), which all rows of a table share, whatever their presets say."""

METHODS = {
    "PointNetLK": "pointnetlk",
    "PointNetLK Revisited": "pointnetlk-revisited",
    "DCP": "dcp",
    "PRNet": "prnet",
    "IDAM": "idam",
    "OMNet": "omnet",
    "FINet": "finet",
    "RPM-Net": "rpmnet",
    "RPM-Net, observed normals": "rpmnet",
    "PCRNet": "pcrnet",
    "MaskNet, then ICP": "masknet",
}
"""The preset of each method, by its name in a table."""

FLAGS: dict[str, Flags] = {
    "RPM-Net, observed normals": {"data.normals": "observed"},
    "MaskNet, then ICP": {"model.share": 0.75, "model.loss": "bce"},
}
"""What a row changes: normals as a sensor's cloud gives them; MaskNet's choice, which would leave out none of equally many points, and
its loss: where nearly all points overlap, squared errors saturate the mask within a few steps and nothing is learned any more."""

QUOTED: dict[str, dict[str, Quoted]] = {
    "table1": {
        "PointNetLK": Quoted(16.788, 7.552, 0.0429, 0.0289),
        "DCP": Quoted(6.649, 4.847, 0.0273, 0.0215),
        "PRNet": Quoted(3.142, 1.458, 0.0163, 0.0119),
        "IDAM": Quoted(2.461, 0.561, 0.0167, 0.0035),
        "OMNet": Quoted(1.499, 0.655, 0.0110, 0.0067),
        "FINet": Quoted(1.463, 0.642, 0.0112, 0.0068),
        "VRNet": Quoted(0.982, 0.496, 0.0061, 0.0039),
    },
    "table2": {
        "PointNetLK": Quoted(22.824, 9.548, 0.0621, 0.0214),
        "DCP": Quoted(9.837, 6.645, 0.0338, 0.0252),
        "PRNet": Quoted(4.992, 2.547, 0.0287, 0.0149),
        "IDAM": Quoted(3.042, 0.616, 0.0197, 0.0048),
        "OMNet": Quoted(2.625, 1.010, 0.0143, 0.0075),
        "FINet": Quoted(2.391, 0.801, 0.0105, 0.0045),
        "VRNet": Quoted(2.121, 0.585, 0.0063, 0.0039),
    },
    "table3": {
        "PointNetLK": Quoted(18.926, 8.944, 0.0647, 0.0423),
        "DCP": Quoted(6.925, 4.487, 0.0242, 0.0187),
        "PRNet": Quoted(4.323, 2.196, 0.0195, 0.0140),
        "IDAM": Quoted(3.721, 1.855, 0.0232, 0.0118),
        "OMNet": Quoted(2.373, 0.948, 0.0168, 0.0086),
        "FINet": Quoted(1.706, 0.937, 0.0124, 0.0084),
        "VRNet": Quoted(3.615, 1.637, 0.0101, 0.0063),
    },
    "table4": {
        "PointNetLK": Quoted(38.991, 21.262, 0.2451, 0.1429),
        "DCP": Quoted(9.932, 6.821, 0.0969, 0.0724),
        "PRNet": Quoted(8.116, 4.942, 0.0871, 0.0498),
        "IDAM": Quoted(9.603, 5.296, 0.1006, 0.0544),
        "OMNet": Quoted(4.972, 3.567, 0.0524, 0.0381),
        "FINet": Quoted(5.059, 2.894, 0.0360, 0.0273),
    },
    "table5": {
        "PointNetLK": Quoted(4.055, 2.908, 0.0325, 0.0092),
        "DCP": Quoted(6.742, 4.195, 0.0376, 0.0213),
        "PRNet": Quoted(2.915, 1.143, 0.0142, 0.0097),
        "IDAM": Quoted(8.594, 5.761, 0.0329, 0.0231),
        "OMNet": Quoted(1.449, 0.836, 0.0071, 0.0047),
        "FINet": Quoted(1.782, 0.903, 0.0094, 0.0051),
    },
}


def compared(table: str = "", flags: Flags | None = None, suffix: str = "") -> tuple[Row, ...]:
    """Return a row for each method, with the figures that a table of the paper prints; VRNet has no code to run.

    Args:
        table: of the paper; empty for tables that it does not have.
        flags: what all rows change.
        suffix: of the labels.
    """
    quoted = QUOTED.get(table, {})
    changes = {label: {**(flags or {}), **FLAGS.get(label, {})} for label in METHODS}
    rows = tuple(Row(label + suffix, preset, changes[label], quoted=quoted.get(label)) for label, preset in METHODS.items())
    if not quoted:
        return rows
    return (*rows, Row("VRNet", None, quoted=quoted.get("VRNet"), absent="no public code"))
