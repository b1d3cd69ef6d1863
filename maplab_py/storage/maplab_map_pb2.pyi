from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Id(_message.Message):
    __slots__ = ("words",)
    WORDS_FIELD_NUMBER: _ClassVar[int]
    words: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, words: _Optional[_Iterable[int]] = ...) -> None: ...

class FileTypeWithPath(_message.Message):
    __slots__ = ("file_type", "path")
    FILE_TYPE_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    file_type: int
    path: str
    def __init__(self, file_type: _Optional[int] = ..., path: _Optional[str] = ...) -> None: ...

class VIMapMetadata(_message.Message):
    __slots__ = ("files",)
    FILES_FIELD_NUMBER: _ClassVar[int]
    files: _containers.RepeatedCompositeFieldContainer[FileTypeWithPath]
    def __init__(self, files: _Optional[_Iterable[_Union[FileTypeWithPath, _Mapping]]] = ...) -> None: ...

class VIMap(_message.Message):
    __slots__ = ("vertex_ids", "vertices", "edge_ids", "edges", "mission_ids", "missions", "baseframe_ids", "baseframes", "legacy_landmark_ids", "landmark_index")
    VERTEX_IDS_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    EDGE_IDS_FIELD_NUMBER: _ClassVar[int]
    EDGES_FIELD_NUMBER: _ClassVar[int]
    MISSION_IDS_FIELD_NUMBER: _ClassVar[int]
    MISSIONS_FIELD_NUMBER: _ClassVar[int]
    BASEFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    BASEFRAMES_FIELD_NUMBER: _ClassVar[int]
    LEGACY_LANDMARK_IDS_FIELD_NUMBER: _ClassVar[int]
    LANDMARK_INDEX_FIELD_NUMBER: _ClassVar[int]
    vertex_ids: _containers.RepeatedCompositeFieldContainer[Id]
    vertices: _containers.RepeatedCompositeFieldContainer[Vertex]
    edge_ids: _containers.RepeatedCompositeFieldContainer[Id]
    edges: _containers.RepeatedCompositeFieldContainer[Edge]
    mission_ids: _containers.RepeatedCompositeFieldContainer[Id]
    missions: _containers.RepeatedCompositeFieldContainer[Mission]
    baseframe_ids: _containers.RepeatedCompositeFieldContainer[Id]
    baseframes: _containers.RepeatedCompositeFieldContainer[BaseFrame]
    legacy_landmark_ids: _containers.RepeatedCompositeFieldContainer[Id]
    landmark_index: _containers.RepeatedCompositeFieldContainer[LandmarkIndexEntry]
    def __init__(self, vertex_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., vertices: _Optional[_Iterable[_Union[Vertex, _Mapping]]] = ..., edge_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., edges: _Optional[_Iterable[_Union[Edge, _Mapping]]] = ..., mission_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., missions: _Optional[_Iterable[_Union[Mission, _Mapping]]] = ..., baseframe_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., baseframes: _Optional[_Iterable[_Union[BaseFrame, _Mapping]]] = ..., legacy_landmark_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., landmark_index: _Optional[_Iterable[_Union[LandmarkIndexEntry, _Mapping]]] = ...) -> None: ...

class Vertex(_message.Message):
    __slots__ = ("incoming_edges", "outgoing_edges", "T_M_I", "v_M", "accel_bias", "gyro_bias", "nframe", "landmark_store", "frame_resources", "mission_id", "absolute_poses")
    INCOMING_EDGES_FIELD_NUMBER: _ClassVar[int]
    OUTGOING_EDGES_FIELD_NUMBER: _ClassVar[int]
    T_M_I_FIELD_NUMBER: _ClassVar[int]
    V_M_FIELD_NUMBER: _ClassVar[int]
    ACCEL_BIAS_FIELD_NUMBER: _ClassVar[int]
    GYRO_BIAS_FIELD_NUMBER: _ClassVar[int]
    NFRAME_FIELD_NUMBER: _ClassVar[int]
    LANDMARK_STORE_FIELD_NUMBER: _ClassVar[int]
    FRAME_RESOURCES_FIELD_NUMBER: _ClassVar[int]
    MISSION_ID_FIELD_NUMBER: _ClassVar[int]
    ABSOLUTE_POSES_FIELD_NUMBER: _ClassVar[int]
    incoming_edges: _containers.RepeatedCompositeFieldContainer[Id]
    outgoing_edges: _containers.RepeatedCompositeFieldContainer[Id]
    T_M_I: _containers.RepeatedScalarFieldContainer[float]
    v_M: _containers.RepeatedScalarFieldContainer[float]
    accel_bias: _containers.RepeatedScalarFieldContainer[float]
    gyro_bias: _containers.RepeatedScalarFieldContainer[float]
    nframe: VisualNFrame
    landmark_store: LandmarkStore
    frame_resources: _containers.RepeatedCompositeFieldContainer[FrameResources]
    mission_id: Id
    absolute_poses: _containers.RepeatedCompositeFieldContainer[AbsolutePose]
    def __init__(self, incoming_edges: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., outgoing_edges: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., T_M_I: _Optional[_Iterable[float]] = ..., v_M: _Optional[_Iterable[float]] = ..., accel_bias: _Optional[_Iterable[float]] = ..., gyro_bias: _Optional[_Iterable[float]] = ..., nframe: _Optional[_Union[VisualNFrame, _Mapping]] = ..., landmark_store: _Optional[_Union[LandmarkStore, _Mapping]] = ..., frame_resources: _Optional[_Iterable[_Union[FrameResources, _Mapping]]] = ..., mission_id: _Optional[_Union[Id, _Mapping]] = ..., absolute_poses: _Optional[_Iterable[_Union[AbsolutePose, _Mapping]]] = ...) -> None: ...

class AbsolutePose(_message.Message):
    __slots__ = ("timestamp_ns", "sensor_id", "T_G_S", "covariance")
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    T_G_S_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    timestamp_ns: int
    sensor_id: Id
    T_G_S: _containers.RepeatedScalarFieldContainer[float]
    covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, timestamp_ns: _Optional[int] = ..., sensor_id: _Optional[_Union[Id, _Mapping]] = ..., T_G_S: _Optional[_Iterable[float]] = ..., covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class VisualNFrame(_message.Message):
    __slots__ = ("id", "frames")
    ID_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    id: Id
    frames: _containers.RepeatedCompositeFieldContainer[VisualFrame]
    def __init__(self, id: _Optional[_Union[Id, _Mapping]] = ..., frames: _Optional[_Iterable[_Union[VisualFrame, _Mapping]]] = ...) -> None: ...

class VisualFrame(_message.Message):
    __slots__ = ("id", "timestamp_ns", "keypoints_px", "sigmas_px", "descriptors", "landmark_ids", "scales", "is_valid", "track_ids", "descriptor_types", "positions_3d", "time_offsets_ns")
    ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_PX_FIELD_NUMBER: _ClassVar[int]
    SIGMAS_PX_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTORS_FIELD_NUMBER: _ClassVar[int]
    LANDMARK_IDS_FIELD_NUMBER: _ClassVar[int]
    SCALES_FIELD_NUMBER: _ClassVar[int]
    IS_VALID_FIELD_NUMBER: _ClassVar[int]
    TRACK_IDS_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTOR_TYPES_FIELD_NUMBER: _ClassVar[int]
    POSITIONS_3D_FIELD_NUMBER: _ClassVar[int]
    TIME_OFFSETS_NS_FIELD_NUMBER: _ClassVar[int]
    id: Id
    timestamp_ns: int
    keypoints_px: _containers.RepeatedScalarFieldContainer[float]
    sigmas_px: _containers.RepeatedScalarFieldContainer[float]
    descriptors: bytes
    landmark_ids: _containers.RepeatedCompositeFieldContainer[Id]
    scales: _containers.RepeatedScalarFieldContainer[float]
    is_valid: bool
    track_ids: _containers.RepeatedScalarFieldContainer[int]
    descriptor_types: _containers.RepeatedScalarFieldContainer[int]
    positions_3d: _containers.RepeatedScalarFieldContainer[float]
    time_offsets_ns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, id: _Optional[_Union[Id, _Mapping]] = ..., timestamp_ns: _Optional[int] = ..., keypoints_px: _Optional[_Iterable[float]] = ..., sigmas_px: _Optional[_Iterable[float]] = ..., descriptors: _Optional[bytes] = ..., landmark_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., scales: _Optional[_Iterable[float]] = ..., is_valid: bool = ..., track_ids: _Optional[_Iterable[int]] = ..., descriptor_types: _Optional[_Iterable[int]] = ..., positions_3d: _Optional[_Iterable[float]] = ..., time_offsets_ns: _Optional[_Iterable[int]] = ...) -> None: ...

class LandmarkStore(_message.Message):
    __slots__ = ("landmarks",)
    LANDMARKS_FIELD_NUMBER: _ClassVar[int]
    landmarks: _containers.RepeatedCompositeFieldContainer[Landmark]
    def __init__(self, landmarks: _Optional[_Iterable[_Union[Landmark, _Mapping]]] = ...) -> None: ...

class Landmark(_message.Message):
    __slots__ = ("id", "p_I", "covariance", "observer_vertex_ids", "keypoint_indices", "frame_indices", "quality", "feature_type")
    ID_FIELD_NUMBER: _ClassVar[int]
    P_I_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    OBSERVER_VERTEX_IDS_FIELD_NUMBER: _ClassVar[int]
    KEYPOINT_INDICES_FIELD_NUMBER: _ClassVar[int]
    FRAME_INDICES_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    FEATURE_TYPE_FIELD_NUMBER: _ClassVar[int]
    id: Id
    p_I: _containers.RepeatedScalarFieldContainer[float]
    covariance: _containers.RepeatedScalarFieldContainer[float]
    observer_vertex_ids: _containers.RepeatedCompositeFieldContainer[Id]
    keypoint_indices: _containers.RepeatedScalarFieldContainer[int]
    frame_indices: _containers.RepeatedScalarFieldContainer[int]
    quality: int
    feature_type: int
    def __init__(self, id: _Optional[_Union[Id, _Mapping]] = ..., p_I: _Optional[_Iterable[float]] = ..., covariance: _Optional[_Iterable[float]] = ..., observer_vertex_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., keypoint_indices: _Optional[_Iterable[int]] = ..., frame_indices: _Optional[_Iterable[int]] = ..., quality: _Optional[int] = ..., feature_type: _Optional[int] = ...) -> None: ...

class LandmarkIndexEntry(_message.Message):
    __slots__ = ("vertex_id", "landmark_id")
    VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    LANDMARK_ID_FIELD_NUMBER: _ClassVar[int]
    vertex_id: Id
    landmark_id: Id
    def __init__(self, vertex_id: _Optional[_Union[Id, _Mapping]] = ..., landmark_id: _Optional[_Union[Id, _Mapping]] = ...) -> None: ...

class FrameResources(_message.Message):
    __slots__ = ("resources",)
    RESOURCES_FIELD_NUMBER: _ClassVar[int]
    resources: _containers.RepeatedCompositeFieldContainer[ResourcesOfType]
    def __init__(self, resources: _Optional[_Iterable[_Union[ResourcesOfType, _Mapping]]] = ...) -> None: ...

class ResourcesOfType(_message.Message):
    __slots__ = ("type", "resource_ids")
    TYPE_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_IDS_FIELD_NUMBER: _ClassVar[int]
    type: int
    resource_ids: _containers.RepeatedCompositeFieldContainer[Id]
    def __init__(self, type: _Optional[int] = ..., resource_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ...) -> None: ...

class Edge(_message.Message):
    __slots__ = ("imu", "odometry", "loop_closure", "transformation", "wheel_odometry")
    IMU_FIELD_NUMBER: _ClassVar[int]
    ODOMETRY_FIELD_NUMBER: _ClassVar[int]
    LOOP_CLOSURE_FIELD_NUMBER: _ClassVar[int]
    TRANSFORMATION_FIELD_NUMBER: _ClassVar[int]
    WHEEL_ODOMETRY_FIELD_NUMBER: _ClassVar[int]
    imu: ImuEdge
    odometry: TransformationEdge
    loop_closure: LoopClosureEdge
    transformation: TransformationEdge
    wheel_odometry: TransformationEdge
    def __init__(self, imu: _Optional[_Union[ImuEdge, _Mapping]] = ..., odometry: _Optional[_Union[TransformationEdge, _Mapping]] = ..., loop_closure: _Optional[_Union[LoopClosureEdge, _Mapping]] = ..., transformation: _Optional[_Union[TransformationEdge, _Mapping]] = ..., wheel_odometry: _Optional[_Union[TransformationEdge, _Mapping]] = ...) -> None: ...

class ImuEdge(_message.Message):
    __slots__ = ("from_vertex_id", "to_vertex_id", "timestamps_ns", "accel_gyro", "mission_id")
    FROM_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    TO_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMPS_NS_FIELD_NUMBER: _ClassVar[int]
    ACCEL_GYRO_FIELD_NUMBER: _ClassVar[int]
    MISSION_ID_FIELD_NUMBER: _ClassVar[int]
    from_vertex_id: Id
    to_vertex_id: Id
    timestamps_ns: _containers.RepeatedScalarFieldContainer[int]
    accel_gyro: _containers.RepeatedScalarFieldContainer[float]
    mission_id: Id
    def __init__(self, from_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., to_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., timestamps_ns: _Optional[_Iterable[int]] = ..., accel_gyro: _Optional[_Iterable[float]] = ..., mission_id: _Optional[_Union[Id, _Mapping]] = ...) -> None: ...

class TransformationEdge(_message.Message):
    __slots__ = ("from_vertex_id", "to_vertex_id", "mission_id", "T_A_B", "covariance", "sensor_id")
    FROM_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    TO_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    MISSION_ID_FIELD_NUMBER: _ClassVar[int]
    T_A_B_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    from_vertex_id: Id
    to_vertex_id: Id
    mission_id: Id
    T_A_B: _containers.RepeatedScalarFieldContainer[float]
    covariance: _containers.RepeatedScalarFieldContainer[float]
    sensor_id: Id
    def __init__(self, from_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., to_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., mission_id: _Optional[_Union[Id, _Mapping]] = ..., T_A_B: _Optional[_Iterable[float]] = ..., covariance: _Optional[_Iterable[float]] = ..., sensor_id: _Optional[_Union[Id, _Mapping]] = ...) -> None: ...

class LoopClosureEdge(_message.Message):
    __slots__ = ("from_vertex_id", "to_vertex_id", "mission_id", "T_A_B", "covariance", "switch_variable", "switch_variable_variance")
    FROM_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    TO_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    MISSION_ID_FIELD_NUMBER: _ClassVar[int]
    T_A_B_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    SWITCH_VARIABLE_FIELD_NUMBER: _ClassVar[int]
    SWITCH_VARIABLE_VARIANCE_FIELD_NUMBER: _ClassVar[int]
    from_vertex_id: Id
    to_vertex_id: Id
    mission_id: Id
    T_A_B: _containers.RepeatedScalarFieldContainer[float]
    covariance: _containers.RepeatedScalarFieldContainer[float]
    switch_variable: float
    switch_variable_variance: float
    def __init__(self, from_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., to_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., mission_id: _Optional[_Union[Id, _Mapping]] = ..., T_A_B: _Optional[_Iterable[float]] = ..., covariance: _Optional[_Iterable[float]] = ..., switch_variable: _Optional[float] = ..., switch_variable_variance: _Optional[float] = ...) -> None: ...

class Mission(_message.Message):
    __slots__ = ("baseframe_id", "root_vertex_id", "backbone", "resource_ids", "resource_types", "sensor_resources", "ncamera_id", "imu_id", "lidar_id", "odometry_6dof_id", "loop_closure_id", "absolute_6dof_id", "detection_id", "wheel_odometry_id")
    BASEFRAME_ID_FIELD_NUMBER: _ClassVar[int]
    ROOT_VERTEX_ID_FIELD_NUMBER: _ClassVar[int]
    BACKBONE_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_IDS_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_TYPES_FIELD_NUMBER: _ClassVar[int]
    SENSOR_RESOURCES_FIELD_NUMBER: _ClassVar[int]
    NCAMERA_ID_FIELD_NUMBER: _ClassVar[int]
    IMU_ID_FIELD_NUMBER: _ClassVar[int]
    LIDAR_ID_FIELD_NUMBER: _ClassVar[int]
    ODOMETRY_6DOF_ID_FIELD_NUMBER: _ClassVar[int]
    LOOP_CLOSURE_ID_FIELD_NUMBER: _ClassVar[int]
    ABSOLUTE_6DOF_ID_FIELD_NUMBER: _ClassVar[int]
    DETECTION_ID_FIELD_NUMBER: _ClassVar[int]
    WHEEL_ODOMETRY_ID_FIELD_NUMBER: _ClassVar[int]
    baseframe_id: Id
    root_vertex_id: Id
    backbone: int
    resource_ids: _containers.RepeatedCompositeFieldContainer[Id]
    resource_types: _containers.RepeatedScalarFieldContainer[int]
    sensor_resources: _containers.RepeatedCompositeFieldContainer[SensorResource]
    ncamera_id: Id
    imu_id: Id
    lidar_id: Id
    odometry_6dof_id: Id
    loop_closure_id: Id
    absolute_6dof_id: Id
    detection_id: Id
    wheel_odometry_id: Id
    def __init__(self, baseframe_id: _Optional[_Union[Id, _Mapping]] = ..., root_vertex_id: _Optional[_Union[Id, _Mapping]] = ..., backbone: _Optional[int] = ..., resource_ids: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., resource_types: _Optional[_Iterable[int]] = ..., sensor_resources: _Optional[_Iterable[_Union[SensorResource, _Mapping]]] = ..., ncamera_id: _Optional[_Union[Id, _Mapping]] = ..., imu_id: _Optional[_Union[Id, _Mapping]] = ..., lidar_id: _Optional[_Union[Id, _Mapping]] = ..., odometry_6dof_id: _Optional[_Union[Id, _Mapping]] = ..., loop_closure_id: _Optional[_Union[Id, _Mapping]] = ..., absolute_6dof_id: _Optional[_Union[Id, _Mapping]] = ..., detection_id: _Optional[_Union[Id, _Mapping]] = ..., wheel_odometry_id: _Optional[_Union[Id, _Mapping]] = ...) -> None: ...

class SensorResource(_message.Message):
    __slots__ = ("sensor_id", "timestamp_ns", "resource_id", "resource_type")
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_NS_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_ID_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_TYPE_FIELD_NUMBER: _ClassVar[int]
    sensor_id: Id
    timestamp_ns: int
    resource_id: Id
    resource_type: int
    def __init__(self, sensor_id: _Optional[_Union[Id, _Mapping]] = ..., timestamp_ns: _Optional[int] = ..., resource_id: _Optional[_Union[Id, _Mapping]] = ..., resource_type: _Optional[int] = ...) -> None: ...

class BaseFrame(_message.Message):
    __slots__ = ("T_G_M", "T_G_M_covariance", "is_T_G_M_known")
    T_G_M_FIELD_NUMBER: _ClassVar[int]
    T_G_M_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    IS_T_G_M_KNOWN_FIELD_NUMBER: _ClassVar[int]
    T_G_M: _containers.RepeatedScalarFieldContainer[float]
    T_G_M_covariance: _containers.RepeatedScalarFieldContainer[float]
    is_T_G_M_known: bool
    def __init__(self, T_G_M: _Optional[_Iterable[float]] = ..., T_G_M_covariance: _Optional[_Iterable[float]] = ..., is_T_G_M_known: bool = ...) -> None: ...

class MetaData(_message.Message):
    __slots__ = ("map_folder", "map_description", "resource_folder_in_use", "map_resource_folder", "external_resource_folders")
    MAP_FOLDER_FIELD_NUMBER: _ClassVar[int]
    MAP_DESCRIPTION_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_FOLDER_IN_USE_FIELD_NUMBER: _ClassVar[int]
    MAP_RESOURCE_FOLDER_FIELD_NUMBER: _ClassVar[int]
    EXTERNAL_RESOURCE_FOLDERS_FIELD_NUMBER: _ClassVar[int]
    map_folder: str
    map_description: str
    resource_folder_in_use: int
    map_resource_folder: str
    external_resource_folders: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, map_folder: _Optional[str] = ..., map_description: _Optional[str] = ..., resource_folder_in_use: _Optional[int] = ..., map_resource_folder: _Optional[str] = ..., external_resource_folders: _Optional[_Iterable[str]] = ...) -> None: ...

class ResourceInfoMap(_message.Message):
    __slots__ = ("resource_type", "resource_id", "resource_info")
    RESOURCE_TYPE_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_ID_FIELD_NUMBER: _ClassVar[int]
    RESOURCE_INFO_FIELD_NUMBER: _ClassVar[int]
    resource_type: _containers.RepeatedScalarFieldContainer[int]
    resource_id: _containers.RepeatedCompositeFieldContainer[Id]
    resource_info: _containers.RepeatedCompositeFieldContainer[ResourceInfo]
    def __init__(self, resource_type: _Optional[_Iterable[int]] = ..., resource_id: _Optional[_Iterable[_Union[Id, _Mapping]]] = ..., resource_info: _Optional[_Iterable[_Union[ResourceInfo, _Mapping]]] = ...) -> None: ...

class ResourceInfo(_message.Message):
    __slots__ = ("folder_idx",)
    FOLDER_IDX_FIELD_NUMBER: _ClassVar[int]
    folder_idx: int
    def __init__(self, folder_idx: _Optional[int] = ...) -> None: ...

class LocalizationSummaryMap(_message.Message):
    __slots__ = ("p_G_landmark", "uncompressed_map", "extras")
    P_G_LANDMARK_FIELD_NUMBER: _ClassVar[int]
    UNCOMPRESSED_MAP_FIELD_NUMBER: _ClassVar[int]
    EXTRAS_FIELD_NUMBER: _ClassVar[int]
    p_G_landmark: _containers.RepeatedScalarFieldContainer[float]
    uncompressed_map: UncompressedLocalizationSummaryMap
    extras: SummaryMapExtras
    def __init__(self, p_G_landmark: _Optional[_Iterable[float]] = ..., uncompressed_map: _Optional[_Union[UncompressedLocalizationSummaryMap, _Mapping]] = ..., extras: _Optional[_Union[SummaryMapExtras, _Mapping]] = ...) -> None: ...

class SummaryMapExtras(_message.Message):
    __slots__ = ("landmark_covariance", "landmark_ids", "observer_ids", "sensors_yaml", "projection", "sha256", "descriptor_kind")
    LANDMARK_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    LANDMARK_IDS_FIELD_NUMBER: _ClassVar[int]
    OBSERVER_IDS_FIELD_NUMBER: _ClassVar[int]
    SENSORS_YAML_FIELD_NUMBER: _ClassVar[int]
    PROJECTION_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTOR_KIND_FIELD_NUMBER: _ClassVar[int]
    landmark_covariance: _containers.RepeatedScalarFieldContainer[float]
    landmark_ids: bytes
    observer_ids: bytes
    sensors_yaml: str
    projection: MatrixXf
    sha256: bytes
    descriptor_kind: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, landmark_covariance: _Optional[_Iterable[float]] = ..., landmark_ids: _Optional[bytes] = ..., observer_ids: _Optional[bytes] = ..., sensors_yaml: _Optional[str] = ..., projection: _Optional[_Union[MatrixXf, _Mapping]] = ..., sha256: _Optional[bytes] = ..., descriptor_kind: _Optional[_Iterable[int]] = ...) -> None: ...

class UncompressedLocalizationSummaryMap(_message.Message):
    __slots__ = ("descriptors", "p_G_observer", "observer_indices", "observation_to_landmark_index")
    DESCRIPTORS_FIELD_NUMBER: _ClassVar[int]
    P_G_OBSERVER_FIELD_NUMBER: _ClassVar[int]
    OBSERVER_INDICES_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_TO_LANDMARK_INDEX_FIELD_NUMBER: _ClassVar[int]
    descriptors: MatrixXf
    p_G_observer: _containers.RepeatedScalarFieldContainer[float]
    observer_indices: _containers.RepeatedScalarFieldContainer[int]
    observation_to_landmark_index: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, descriptors: _Optional[_Union[MatrixXf, _Mapping]] = ..., p_G_observer: _Optional[_Iterable[float]] = ..., observer_indices: _Optional[_Iterable[int]] = ..., observation_to_landmark_index: _Optional[_Iterable[int]] = ...) -> None: ...

class MatrixXf(_message.Message):
    __slots__ = ("rows", "cols", "data")
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLS_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    rows: int
    cols: int
    data: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, rows: _Optional[int] = ..., cols: _Optional[int] = ..., data: _Optional[_Iterable[float]] = ...) -> None: ...
