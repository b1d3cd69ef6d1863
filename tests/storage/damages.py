"""Every way to damage a map that tests know, and what must be said about it."""

import gzip
from typing import Any

from tests.storage.damaging import (
    BOUND_MEGABYTES,
    NAN,
    Damage,
    absolute_pose,
    appended,
    back_to_the_vertex_before,
    baseframe,
    clear,
    content,
    cut,
    edges,
    extra_word,
    flipped,
    frame,
    imu,
    index,
    info,
    landmark,
    loop,
    mission,
    missions,
    odometry,
    other_checksum,
    other_id,
    put,
    redirected,
    removed,
    replaced,
    swap_ends,
    swap_files,
    truncated_listing,
    unlisted,
    vertex,
    vertices,
    yaml_bomb,
    zeros,
)

_MEMBERS = gzip.compress(b"")
_BOMB = gzip.compress(bytes((BOUND_MEGABYTES + 1) * 1_000_000))
_LARGE = ("--proto_max_size_megabytes",)
_BINARY = ("missions", "vertices0", "vertices1", "edges0", "landmark_index")


def _each_file() -> dict[str, Damage]:
    found: dict[str, Damage] = {}
    for name in _BINARY:
        path = f"vi_map/{name}"
        found[f"{name} missing"] = Damage(removed(path), path, ("not there",))
        found[f"{name} truncated"] = Damage(cut(path, 100), path, ("truncated",))
        found[f"{name} of zero bytes"] = Damage(content(path, b""), path)
        found[f"{name} with a flipped byte"] = Damage(flipped(path), path, ("damaged",))
        found[f"{name} with rubbish behind"] = Damage(appended(path, b"rubbish"), path, ("follow",))
        found[f"{name} with half a second member"] = Damage(
            appended(path, _MEMBERS[:9]), path, ("truncated",)
        )
        found[f"{name} no message"] = Damage(
            content(path, gzip.compress(b"\xff" * 4000)), path, ("not a message",)
        )
        found[f"{name} a gzip bomb"] = Damage(content(path, _BOMB), path, _LARGE)
        found[f"{name} a bomb of two members"] = Damage(
            content(path, gzip.compress(bytes(BOUND_MEGABYTES * 600_000)) * 2), path, _LARGE
        )
        found[f"{name} a folder"] = Damage(
            lambda folder, path=path: ((folder / path).unlink(), (folder / path).mkdir()),
            path,
            ("cannot be read",),
        )
        found[f"{name} not listed"] = Damage(
            lambda folder, name=name: unlisted(folder, name), "", ("vi_map",)
        )
    # the landmark index alone may be empty as a file; what is wrong is said of the index
    found["landmark_index of zero bytes"] = Damage(
        content("vi_map/landmark_index", b""), "vi_map", ("landmark index disagrees",)
    )
    found["edges0 of zero bytes"] = Damage(
        content("vi_map/edges0", b""), "vi_map/vertices0", ("is not in the map", "_edges")
    )
    return found


_LISTING = "vi_map/vi_map_metadata"
_FILES = {
    "listing missing": Damage(removed(_LISTING), "", ("is not a map",)),
    "listing empty": Damage(content(_LISTING, b""), _LISTING, ("no file of missions",)),
    "listing no text": Damage(content(_LISTING, b"\xff\xfe\x00"), _LISTING, ("not UTF-8",)),
    "listing truncated": Damage(truncated_listing, _LISTING),
    "listing with files misspelt": Damage(
        replaced(_LISTING, "files", "filez"), _LISTING, ("filez",)
    ),
    "listing with an unknown type": Damage(
        replaced(_LISTING, "file_type: 3", "file_type: 9"), _LISTING, ("file_type",)
    ),
    "listing with a wrong type": Damage(
        replaced(_LISTING, "file_type: 3", "file_type: 2"), "vi_map/landmark_index", ("edges",)
    ),
    "listing without type": Damage(
        replaced(_LISTING, "file_type: 3", ""), _LISTING, ("file_type",)
    ),
    "listing with a file twice": Damage(
        replaced(_LISTING, "vertices1", "vertices0"), _LISTING, ("twice",)
    ),
    "listing that leaves the folder": Damage(
        replaced(_LISTING, '"edges0"', '"../edges0"'), _LISTING, ("leaves",)
    ),
    "listing with an absolute path": Damage(
        replaced(_LISTING, '"edges0"', '"/edges0"'), _LISTING, ("leaves",)
    ),
    "listing with NUL in a path": Damage(
        replaced(_LISTING, '"edges0"', '"edges0\\000"'), _LISTING, ("leaves",)
    ),
    "listing of absurd size": Damage(content(_LISTING, b"files {}\n" * 100_000), _LISTING, _LARGE),
    "two files exchanged": Damage(
        lambda f: swap_files(f, "vi_map/missions", "vi_map/edges0"), "vi_map/missions", ("edges",)
    ),
    "sensors.yaml missing": Damage(removed("vi_map/sensors.yaml"), "vi_map/sensors.yaml"),
    "sensors.yaml truncated": Damage(cut("vi_map/sensors.yaml", 300), "vi_map/sensors.yaml"),
    "sensors.yaml no text": Damage(
        content("vi_map/sensors.yaml", b"\xff\xfe"), "vi_map/sensors.yaml", ("UTF-8",)
    ),
    "sensors.yaml with an alias bomb": Damage(yaml_bomb, "vi_map/sensors.yaml", ("aliases",)),
    "sensors.yaml of absurd size": Damage(
        content("vi_map/sensors.yaml", b"# " * 3_100_000), "vi_map/sensors.yaml", _LARGE
    ),
    "sensors.yaml with too many values": Damage(
        content("vi_map/sensors.yaml", b"x: [" + b"1," * 50_000 + b"]"),
        "vi_map/sensors.yaml",
        _LARGE,
    ),
    "sensors.yaml with a sensor that is not there": Damage(
        lambda f: (f / "vi_map/sensors.yaml").write_text(
            (f / "vi_map/sensors.yaml").read_text().replace("1" * 32, "7" * 32)
        ),
        "",
        ("imu is not in sensors.yaml",),
        is_note=True,
    ),
    "sensors.yaml without extrinsics": Damage(
        lambda f: (f / "vi_map/sensors.yaml").write_text(
            (f / "vi_map/sensors.yaml").read_text().split("extrinsics:")[0]
        ),
        "sensors.yaml",
        ("without extrinsics",),
        is_note=True,
    ),
    "metadata missing": Damage(removed("metadata"), "metadata", ("not there",), is_note=True),
    "metadata misspelt": Damage(
        replaced("metadata", "map_folder", "map_foldr"), "metadata", ("map_foldr",), is_note=True
    ),
    "metadata no text": Damage(content("metadata", b"\xff"), "metadata", ("UTF-8",)),
    "metadata of absurd size": Damage(content("metadata", b"#" * 100_000), "metadata", _LARGE),
    "resource_info missing": Damage(
        removed("resource_info"), "resource_info", ("not there",), is_note=True
    ),
    "resource_info truncated": Damage(cut("resource_info", 30), "resource_info", ("truncated",)),
    "resource_info a bomb": Damage(content("resource_info", _BOMB), "resource_info", _LARGE),
    "resource_info of tiny entries": Damage(
        content("resource_info", zeros(b"\x12\x00", 3_000_000)), "resource_info", _LARGE
    ),
    "resource_info with lists of different length": Damage(
        info(lambda m: m.resource_type.append(3)), "resource_info", ("length",)
    ),
    "resource_info without a folder": Damage(
        info(lambda m: m.resource_info[0].ClearField("folder_idx")), "resource_info"
    ),
    "resource_info with an unknown folder": Damage(
        info(lambda m: setattr(m.resource_info[0], "folder_idx", 7)),
        "",
        ("folder", "metadata"),
        is_note=True,
    ),
    "resource_info with a long id": Damage(
        info(lambda m: m.resource_id[0].words.append(3)), "resource_info", ("3 words",)
    ),
    "checksum of another file": Damage(other_checksum, "vi_map/sensors.yaml", ("checksum",)),
    "checksums no text": Damage(content("checksums.sha256", b"\xff\xff"), "checksums.sha256"),
    "checksums of no digests": Damage(
        content("checksums.sha256", b"abc  vi_map/missions\n"), "checksums.sha256", ("line 1",)
    ),
    "checksums outside": Damage(
        content("checksums.sha256", b"0" * 64 + b"  ../x\n"), "checksums.sha256", ("line 1",)
    ),
    "checksums of absurd size": Damage(
        content("checksums.sha256", b"0" * 17_000_000), "checksums.sha256", ("delete it",)
    ),
}

_VERTICES, _EDGES, _MISSIONS = (
    "vi_map/vertices1: vertex ",
    "vi_map/edges0: edge ",
    "vi_map/missions",
)
_FRAME = ("frame ",)
_FIELDS = {
    "T_M_I with NaN": Damage(vertex(put("T_M_I", 4, NAN)), _VERTICES, ("T_M_I",)),
    "T_M_I with a zero quaternion": Damage(
        vertex(lambda v: [put("T_M_I", k, 0.0)(v) for k in range(4)]),
        _VERTICES,
        ("T_M_I", "length 0"),
    ),
    "T_M_I short": Damage(vertex(lambda v: v.T_M_I.pop()), _VERTICES, ("T_M_I", "6 numbers")),
    "v_M with NaN": Damage(vertex(put("v_M", 0, NAN)), _VERTICES, ("v_M",)),
    "gyro_bias long": Damage(vertex(lambda v: v.gyro_bias.append(0)), _VERTICES, ("gyro_bias",)),
    "vertex without mission": Damage(vertex(clear("mission_id")), _VERTICES, ("no mission",)),
    "vertex of another mission": Damage(
        vertex(lambda v: other_id(v, "mission_id")), _VERTICES, ("mission", "not in the map")
    ),
    "vertex with a long mission id": Damage(
        vertex(extra_word("mission_id")), _VERTICES, ("3 words",)
    ),
    "vertex id twice": Damage(
        vertices(lambda m: m.vertex_ids[1].CopyFrom(m.vertex_ids[0])),
        "vi_map/vertices1",
        ("twice",),
    ),
    "vertex id zero": Damage(
        vertices(lambda m: m.vertex_ids[1].ClearField("words")), "vi_map/vertices1", ("no id",)
    ),
    "vertex id of three words": Damage(
        vertices(lambda m: m.vertex_ids[1].words.append(1)), "vi_map/vertices1", ("3 words",)
    ),
    "fewer vertices than ids": Damage(
        vertices(lambda m: m.vertices.pop()), "vi_map/vertices1", ("9 vertices", "10 vertex_ids")
    ),
    "edges in a file of vertices": Damage(
        vertices(lambda m: m.edge_ids.add()), "vi_map/vertices1", ("holds edge_ids",)
    ),
    "a vertex lost": Damage(
        vertices(lambda m: (m.vertices.pop(), m.vertex_ids.pop())),
        "vi_map/edges0",
        ("not in the map",),
    ),
    "a vertex that lists an edge that is not there": Damage(
        vertex(lambda v: v.outgoing_edges.add().words.extend([5, 6])),
        _VERTICES,
        ("outgoing_edges",),
    ),
    "a vertex that lists an edge of another": Damage(
        vertices(lambda m: m.vertices[3].incoming_edges.append(m.vertices[6].incoming_edges[0])),
        _VERTICES,
        ("incoming_edges", "not at this vertex"),
    ),
    "a vertex that lists no edges": Damage(
        vertex(clear("outgoing_edges")), "", ("ends of edges are not listed",), is_note=True
    ),
    "absolute pose with NaN": Damage(
        vertices(
            lambda m: put("T_G_S", 4, NAN)(
                next(v for v in m.vertices if v.absolute_poses).absolute_poses[0]
            )
        ),
        _VERTICES,
        ("T_G_S",),
    ),
    "absolute pose short": Damage(
        absolute_pose(lambda pose: pose.T_G_S.pop()),
        _VERTICES,
        ("T_G_S",),
    ),
    "keypoint with NaN": Damage(
        frame(put("keypoints_px", 1, NAN)), _VERTICES, (*_FRAME, "keypoints_px")
    ),
    "sigma with NaN": Damage(
        frame(
            lambda f: (
                f.sigmas_px.extend([NAN] * (len(f.keypoints_px) // 2 - len(f.sigmas_px)))
                if not f.sigmas_px
                else put("sigmas_px", 0, NAN)(f)
            )
        ),
        _VERTICES,
        (*_FRAME, "sigmas_px"),
    ),
    "odd keypoints": Damage(
        frame(lambda f: f.keypoints_px.append(1.0)), _VERTICES, (*_FRAME, "keypoints_px")
    ),
    "too many sigmas": Damage(
        frame(lambda f: f.sigmas_px.append(1.0)), _VERTICES, (*_FRAME, "sigmas_px")
    ),
    "too few track ids": Damage(
        frame(lambda f: f.track_ids.append(1)), _VERTICES, (*_FRAME, "track_ids")
    ),
    "descriptors short": Damage(
        frame(lambda f: setattr(f, "descriptors", f.descriptors[:-1])),
        _VERTICES,
        (*_FRAME, "descriptor block"),
    ),
    "landmark id of three words": Damage(
        frame(lambda f: f.landmark_ids[0].words.append(3)), _VERTICES, (*_FRAME, "3 words")
    ),
    "keypoint of a landmark that is not there": Damage(
        frame(lambda f: next(i for i in f.landmark_ids if any(i.words)).words.__setitem__(0, 77)),
        _VERTICES,
        (*_FRAME, "--repair"),
    ),
    "landmark with NaN": Damage(landmark(put("p_I", 0, NAN)), _VERTICES, ("landmark ", "position")),
    "landmark covariance short": Damage(
        landmark(lambda lm: lm.covariance.extend([1.0] * 5)), _VERTICES, ("landmark ", "covariance")
    ),
    "landmark covariance with infinity": Damage(
        landmark(lambda lm: lm.covariance.extend([float("inf")] * 9)),
        "",
        ("landmark", "covariance"),
        is_note=True,
    ),
    "landmark of unknown quality": Damage(
        landmark(lambda lm: setattr(lm, "quality", 300)), _VERTICES, ("landmark ", "quality is 300")
    ),
    "landmark lists of different length": Damage(
        landmark(lambda lm: lm.keypoint_indices.pop()), _VERTICES, ("landmark ", "length")
    ),
    "landmark seen by a vertex that is not there": Damage(
        landmark(lambda lm: lm.observer_vertex_ids[0].words.__setitem__(0, 1)),
        "vi_map/",
        ("--repair",),
    ),
    "landmark seen in a frame that is not there": Damage(
        landmark(put("frame_indices", 0, 9)), "vi_map/", ("--repair",)
    ),
    "landmark seen at a keypoint that is not there": Damage(
        landmark(put("keypoint_indices", 0, 4_000_000)), "vi_map/", ("--repair",)
    ),
    "landmark id twice": Damage(landmark(lambda lm: None), "", ()),
    "landmark without id": Damage(
        landmark(clear("id")), "vi_map/vertices1", ("landmark has no id",)
    ),
    "imu data with NaN": Damage(imu(put("accel_gyro", 3, NAN)), _EDGES, ("IMU data",)),
    "imu data short": Damage(imu(lambda e: e.accel_gyro.pop()), _EDGES, ("measured numbers",)),
    "imu stamps missing": Damage(imu(lambda e: e.timestamps_ns.pop()), _EDGES, ("time stamps",)),
    "imu stamps that run backwards": Damage(
        imu(lambda e: put("timestamps_ns", 2, e.timestamps_ns[1] - 5)(e)),
        "",
        ("times do not increase",),
    ),
    "imu edge to nowhere": Damage(
        imu(lambda e: other_id(e, "to_vertex_id")), _EDGES, ("to-vertex", "not in")
    ),
    "imu edge from nowhere": Damage(imu(clear("from_vertex_id")), _EDGES, ("no from-vertex",)),
    "imu edge that leads back": Damage(redirected(7, "imu", swap_ends), "", ("back in time",)),
    "edge id twice": Damage(
        edges(lambda m: m.edge_ids[1].CopyFrom(m.edge_ids[0])), "vi_map/edges0", ("twice",)
    ),
    "edge without kind": Damage(edges(lambda m: m.edges[4].Clear()), _EDGES, ("no known kind",)),
    "an edge lost": Damage(
        edges(lambda m: (m.edges.pop(), m.edge_ids.pop())), "vi_map/vertices", ("not in the map",)
    ),
    "odometry with NaN": Damage(odometry(put("T_A_B", 6, NAN)), _EDGES, ("T_A_B",)),
    "odometry covariance short": Damage(
        odometry(lambda e: e.covariance.pop()), _EDGES, ("T_A_B_covariance", "35")
    ),
    "odometry in a circle": Damage(
        redirected(61, "odometry", back_to_the_vertex_before), "", ("circle",)
    ),
    "loop closure with NaN": Damage(loop(put("T_A_B", 0, NAN)), _EDGES, ("T_A_B",)),
    "loop closure with a switch of NaN": Damage(
        loop(lambda e: setattr(e, "switch_variable", NAN)), "", ("switch_variable",)
    ),
    "loop closure with a switch of 7": Damage(
        loop(lambda e: setattr(e, "switch_variable", 7.0)), "", ("switch variable",), is_note=True
    ),
    "mission without base frame": Damage(
        mission(clear("baseframe_id")), _MISSIONS, ("no base frame",)
    ),
    "mission of another base frame": Damage(
        mission(lambda m: other_id(m, "baseframe_id")), _MISSIONS, ("base frame", "not in the map")
    ),
    "mission without root": Damage(
        mission(clear("root_vertex_id")), _MISSIONS, ("no root vertex",)
    ),
    "mission of another root": Damage(
        mission(lambda m: other_id(m, "root_vertex_id")), _MISSIONS, ("root vertex",)
    ),
    "mission of unknown backbone": Damage(
        mission(lambda m: setattr(m, "backbone", 9)), _MISSIONS, ("backbone is 9",)
    ),
    "mission with another imu": Damage(
        mission(lambda m: other_id(m, "imu_id")), "", ("imu is not in sensors.yaml",), is_note=True
    ),
    "mission resources of different length": Damage(
        mission(lambda m: m.resource_types.append(1)), _MISSIONS, ("resource_types",)
    ),
    "mission id twice": Damage(
        missions(
            lambda m: (m.mission_ids.append(m.mission_ids[0]), m.missions.append(m.missions[0]))
        ),
        _MISSIONS,
        ("twice",),
    ),
    "mission lost": Damage(
        missions(lambda m: (m.mission_ids.pop(), m.missions.pop())),
        "vi_map/vertices0: vertex ",
        ("mission",),
    ),
    "base frame with NaN": Damage(
        baseframe(put("T_G_M", 4, NAN)), _MISSIONS, ("base frame ", "T_G_M")
    ),
    "base frame covariance short": Damage(
        baseframe(lambda b: b.T_G_M_covariance.extend([1.0])), _MISSIONS, ("T_G_M_covariance",)
    ),
    "index entry lost": Damage(
        index(lambda m: m.landmark_index.pop()), "vi_map/landmark_index", ("--repair",)
    ),
    "index entry of another vertex": Damage(
        index(lambda m: m.landmark_index[0].vertex_id.words.__setitem__(0, 9)),
        "vi_map/landmark_index",
        ("--repair",),
    ),
    "index entry twice": Damage(
        index(lambda m: m.landmark_index[1].CopyFrom(m.landmark_index[0])),
        "vi_map/landmark_index",
        ("--repair",),
    ),
    "index entry of three words": Damage(
        index(lambda m: m.landmark_index[0].landmark_id.words.append(9)),
        "",
        ("landmark_id", "3 words"),
    ),
    "index with old ids": Damage(
        index(lambda m: m.legacy_landmark_ids.add().words.extend([1, 2])), "", ("old ids",)
    ),
}


def _twice_landmark(message: Any) -> None:
    stores = [v.landmark_store.landmarks for v in message.vertices if v.landmark_store.landmarks]
    stores[0][0].id.CopyFrom(stores[-1][-1].id)


_FIELDS["landmark id twice"] = Damage(
    vertices(_twice_landmark), "vi_map/vertices1", ("landmark", "twice")
)
_FIELDS["edge of two kinds"] = Damage(
    edges(lambda m: m.edges[4].loop_closure.SetInParent()), _EDGES, ("imu and loop_closure",)
)

BOMB_ENTRIES: dict[str, tuple[str, bytes, tuple[int, ...]]] = {
    "vertex ids": ("missions", b"\x0a\x00", ()),
    "vertices": ("vertices0", b"\x12\x00", ()),
    "edges": ("edges0", b"\x22\x00", ()),
    "landmark index entries": ("landmark_index", b"\x52\x00", ()),
    "landmarks": ("vertices0", b"\x0a\x00", (0x42, 0x12)),
    "frames": ("vertices0", b"\x12\x00", (0x3A, 0x12)),
    "landmark ids": ("vertices0", b"\x3a\x00", (0x12, 0x3A, 0x12)),
    "listed edges": ("vertices0", b"\x0a\x00", (0x12,)),
    "track ids": ("vertices0", b"\x00", (0x52, 0x12, 0x3A, 0x12)),
    "time stamps": ("edges0", b"\x18\x00", (0x0A, 0x22)),
    "unknown numbers": ("vertices0", b"\x78\x00", (0x12,)),
    "tags with needless zeros": ("missions", b"\x8a\x00\x00", ()),
}
"""Files of tiny entries, each with the tags of the fields around it, innermost first."""
_SIZE = 3_000_000
BOMBS = {
    f"bomb of {what}": Damage(
        content(f"vi_map/{name}", zeros(entry, _SIZE, *wrappers)), f"vi_map/{name}", _LARGE
    )
    for what, (name, entry, wrappers) in BOMB_ENTRIES.items()
}

DAMAGES = {**_each_file(), **_FILES, **_FIELDS, **BOMBS}
