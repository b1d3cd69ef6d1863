"""The truth of a simulated data set, kept apart from the maps: no estimator opens it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.geometry import se3

F64 = NDArray[np.float64]
U64 = NDArray[np.uint64]
I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """True values by id. G is the frame of the simulated world."""

    mission_id: U64  # (M, 2)
    T_G_M: F64  # (M, 7)
    vertex_id: U64  # (V, 2)
    vertex_mission: I64  # (V,) row of mission_id
    vertex_time_ns: I64  # (V,)
    T_G_I: F64  # (V, 7)
    v_G: F64  # (V, 3)
    accel_bias: F64  # (V, 3)
    gyro_bias: F64  # (V, 3)
    landmark_id: U64  # (L, 2) of the maps' landmarks
    landmark_point: I64  # (L,) the world point that most of its observations show
    point_G: F64  # (P, 3) world points

    def save(self, path: Path) -> None:
        """Write the truth to an .npz file."""
        with path.open("wb") as file:
            np.savez_compressed(file, **dataclasses.asdict(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` has written.

        Raises:
            UserError: The file is missing or is not such a file.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        try:
            with np.load(path, allow_pickle=False) as content:
                return cls(**{name: content[name] for name in names})
        except FileNotFoundError:
            raise UserError(f"{path}: there is no such truth file") from None
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path} is not a truth file: {error}") from None

    @classmethod
    def concatenate(cls, parts: list[Self]) -> Self:
        """Join the truths of sessions in one world."""
        sizes = np.cumsum([0, *(len(part.mission_id) for part in parts)])
        values = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in dataclasses.fields(cls)
        }
        values["vertex_mission"] = np.concatenate(
            [part.vertex_mission + size for part, size in zip(parts, sizes, strict=False)]
        )
        return cls(**{**values, "point_G": parts[0].point_G})

    def vertex_p_M(self) -> F64:
        """Return the true positions (V, 3) of the vertices in their missions."""
        T_M_G = se3.inverse(self.T_G_M)[self.vertex_mission]
        return se3.transform(T_M_G, self.T_G_I[:, 4:])
