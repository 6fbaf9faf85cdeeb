"""Bindings of Embree's C interface, in packets of rays.

The library is the one in embreex' wheel. Its Python interface casts single rays and has no instances;
coherent packets are four times as fast. Scenes are handles. The caller that creates a scene releases it.
"""

import ctypes
from functools import cache
from pathlib import Path
from typing import no_type_check

import llvmlite.binding
import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt32, UInt64
from numba import types

from foredrive.errors import InputError
from foredrive.towns.sensing.shading import MISS, Hits

try:
    import embreex
    from embreex import rtcore_scene
except ModuleNotFoundError as error:
    raise InputError(
        "towns cast rays with embreex, which is not installed (it has no wheels for Linux on ARM)"
    ) from error

Rays = Float32[np.ndarray, "N 3"]
Times = Float32[np.ndarray, "_"]
Scenes = UInt64[np.ndarray, "S"]
"""Scene handles."""

EMBREE, EMBREEX = 404, "4.4.0"
"""Release of Embree (major · 100 + minor) from which `_Arguments` and the enums come, and the embreex that
contains it."""
WIDTH = 16
"""Number of rays in a packet."""

_TRIANGLES, _INSTANCE = 0, 121
_INDICES, _VERTICES = 0, 1
_UINT3, _FLOAT3, _FLOAT3X4 = 0x5003, 0x9003, 0x9134
_ROBUST = 1 << 2
"""Flag against leaks along shared edges."""
_COHERENT = 1 << 16
_ALIGNMENT = 64
_VERSION = 0


class _Arguments(ctypes.Structure):
    """RTCIntersectArguments. RTCOccludedArguments has the same layout."""

    _fields_ = (
        ("flags", ctypes.c_int),
        ("feature_mask", ctypes.c_uint),
        ("context", ctypes.c_void_p),
        ("filter", ctypes.c_void_p),
        ("function", ctypes.c_void_p),
        ("spare", ctypes.c_byte * 64),
    )


_arguments = _Arguments(flags=_COHERENT, feature_mask=0xFFFFFFFF)


def _load() -> ctypes.CDLL:
    """Find the library that embreex has loaded.

    It is a dependency of embreex' module or, on Windows, a file beside it.
    """
    library = ctypes.CDLL(rtcore_scene.__file__)
    if hasattr(library, "rtcNewDevice"):
        return library
    folder = Path(embreex.__file__).parent
    for path in sorted([*folder.glob("*embree4*"), *folder.parent.glob("embreex.libs/*embree4*")]):
        return ctypes.CDLL(str(path))
    raise ImportError("embreex is installed without the Embree library that its wheels hold")


_lib = _load()
_handle, _int, _uint, _size = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_size_t
for _name, _result, _parameters in (
    ("rtcNewDevice", _handle, (ctypes.c_char_p,)),
    ("rtcGetDeviceError", _int, (_handle,)),
    ("rtcGetDeviceProperty", ctypes.c_ssize_t, (_handle, _int)),
    ("rtcNewScene", _handle, (_handle,)),
    ("rtcSetSceneFlags", None, (_handle, _int)),
    ("rtcCommitScene", None, (_handle,)),
    ("rtcReleaseScene", None, (_handle,)),
    ("rtcNewGeometry", _handle, (_handle, _int)),
    ("rtcSetSharedGeometryBuffer", None, (_handle, _int, _uint, _int, _handle, _size, _size, _size)),
    ("rtcSetGeometryInstancedScene", None, (_handle, _handle)),
    ("rtcSetGeometryTimeStepCount", None, (_handle, _uint)),
    ("rtcSetGeometryTransform", None, (_handle, _uint, _int, _handle)),
    ("rtcCommitGeometry", None, (_handle,)),
    ("rtcAttachGeometry", _uint, (_handle, _handle)),
    ("rtcReleaseGeometry", None, (_handle,)),
):
    _function = getattr(_lib, _name)
    _function.restype, _function.argtypes = _result, _parameters
for _name in ("rtcIntersect16", "rtcOccluded16"):  # for the compiled functions below, also from numba's cache
    llvmlite.binding.add_symbol(_name, ctypes.cast(getattr(_lib, _name), ctypes.c_void_p).value)
_packet_call = types.void(types.uintp, types.uintp, types.uintp, types.uintp)
_intersect = types.ExternalFunction("rtcIntersect16", _packet_call)
_occluded = types.ExternalFunction("rtcOccluded16", _packet_call)


@cache
def _device() -> int:
    device = int(_lib.rtcNewDevice(None))
    check_release(_lib.rtcGetDeviceProperty(device, _VERSION))
    return device


def check_release(version: int) -> None:
    """Refuse an Embree whose structs may differ from those in this module.

    Args:
        version: version from `rtcGetDeviceProperty`: major · 10000 + minor · 100 + patch.

    Raises:
        InputError: it is another minor release.
    """
    if version // 100 != EMBREE:
        release = f"{version // 10000}.{version // 100 % 100}.{version % 100}"
        raise InputError(
            f"towns need the Embree of embreex {EMBREEX}, but {release} is installed: "
            f"pip install 'embreex=={EMBREEX}.*'"
        )


def new_triangles(xyz: Float32[np.ndarray, "V 3"], faces: UInt32[np.ndarray, "F 3"]) -> int:
    """Create a scene of triangles.

    Both arrays are shared with Embree: keep them unchanged for the lifetime of the scene. One float must
    follow the last vertex in memory, because Embree reads four at a time.
    """
    geometry = _lib.rtcNewGeometry(_device(), _TRIANGLES)
    for kind, form, array in ((_VERTICES, _FLOAT3, xyz), (_INDICES, _UINT3, faces)):
        _lib.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, array.ctypes.data, 0, 12, len(array))
    return _scene_of([geometry])


def new_instances(scenes: list[int], T: Float[np.ndarray, "A K 3 4"]) -> int:
    """Create a scene of other scenes, each moved by K affine maps.

    The maps apply at even steps of time from 0 to 1, with linear interpolation between them. If all maps of a
    scene are equal, they cost no more than one.
    """
    geometries = []
    for scene, steps in zip(scenes, np.ascontiguousarray(T, dtype=np.float32), strict=True):
        # Equal maps need no motion blur
        steps = steps[:1] if (steps == steps[0]).all() else steps
        geometry = _lib.rtcNewGeometry(_device(), _INSTANCE)
        _lib.rtcSetGeometryInstancedScene(geometry, scene)
        _lib.rtcSetGeometryTimeStepCount(geometry, len(steps))
        for step, map_3x4 in enumerate(steps):
            _lib.rtcSetGeometryTransform(geometry, step, _FLOAT3X4, map_3x4.ctypes.data)
        geometries.append(geometry)
    return _scene_of(geometries)


def release(scene: int) -> None:
    """Release the memory of a scene that no other scene uses."""
    _lib.rtcReleaseScene(scene)


def _scene_of(geometries: list[int]) -> int:
    scene = _lib.rtcNewScene(_device())
    _lib.rtcSetSceneFlags(scene, _ROBUST)
    for geometry in geometries:
        _lib.rtcCommitGeometry(geometry)
        _lib.rtcAttachGeometry(scene, geometry)
        _lib.rtcReleaseGeometry(geometry)
    _lib.rtcCommitScene(scene)
    if error := _lib.rtcGetDeviceError(_device()):
        raise MemoryError(f"Embree could not build a scene (its error {error})")
    return int(scene)


# Words of a packet (RTCRayHit16), each with `WIDTH` lanes.
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
_U, _V, _TRIANGLE, _GEOMETRY, _ACTOR, _WORDS = 15, 16, 17, 18, 19, 24

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


@_kernel
@no_type_check
def _aligned(words):
    """Return memory for Embree: 32-bit words that start at a multiple of 64 bytes."""
    memory = np.zeros(words + _ALIGNMENT // 4, np.float32)
    skip = (-memory.ctypes.data % _ALIGNMENT) // 4
    return memory[skip : skip + words]


@_kernel
@no_type_check
def _fill(packet, valid, origin, direction, time, first):
    """Fill the lanes of a packet with rays from `first` on. Lanes beyond the last ray are not valid."""
    whole = packet.view(np.int32)
    for lane in range(WIDTH):
        i = first + lane
        # -1 is a valid lane, 0 an inactive one
        valid[lane] = -1 if i < len(origin) else 0
        if i >= len(origin):
            continue
        for axis in range(3):
            packet[(_ORIGIN + axis) * WIDTH + lane] = origin[i, axis]
            packet[(_DIRECTION + axis) * WIDTH + lane] = direction[i, axis]
        packet[_NEAR * WIDTH + lane] = 0.0
        # Without times all rays are at the middle of the interval
        packet[_TIME * WIDTH + lane] = time[i] if len(time) > 0 else 0.5
        packet[_FAR * WIDTH + lane] = np.inf
        whole[_MASK * WIDTH + lane] = -1
        whole[_ID * WIDTH + lane] = 0
        whole[_FLAGS * WIDTH + lane] = 0


@_kernel
@no_type_check
def _intersect_all(scenes, origin, direction, time, hits, arguments):
    packet, valid = _aligned(_WORDS * WIDTH), _aligned(WIDTH).view(np.int32)
    whole = packet.view(np.int32)
    for first in range(0, len(origin), WIDTH):
        _fill(packet, valid, origin, direction, time, first)
        # MISS in all result words: Embree writes only where there is a hit
        whole[_TRIANGLE * WIDTH : (_ACTOR + 1) * WIDTH] = MISS
        # Each scene shortens `far`, so that the nearest hit of all remains
        for scene in scenes:
            _intersect(valid.ctypes.data, scene, packet.ctypes.data, arguments)
        for lane in range(min(WIDTH, len(origin) - first)):
            i = first + lane
            hits.t[i] = packet[_FAR * WIDTH + lane]
            hits.u[i], hits.v[i] = packet[_U * WIDTH + lane], packet[_V * WIDTH + lane]
            hits.triangle[i], hits.actor[i] = whole[_TRIANGLE * WIDTH + lane], whole[_ACTOR * WIDTH + lane]


@_kernel
@no_type_check
def _occluded_all(scenes, origin, direction, time, out, arguments):
    packet, valid = _aligned(_WORDS * WIDTH), _aligned(WIDTH).view(np.int32)
    for first in range(0, len(origin), WIDTH):
        _fill(packet, valid, origin, direction, time, first)
        for scene in scenes:
            _occluded(valid.ctypes.data, scene, packet.ctypes.data, arguments)
        for lane in range(min(WIDTH, len(origin) - first)):
            # Embree sets `far` to minus infinity where something is hit
            out[first + lane] = packet[_FAR * WIDTH + lane] < 0.0


def intersect(scenes: Scenes, origin: Rays, direction: Rays, time: Times, hits: Hits) -> None:
    """Write the nearest hits of rays with several scenes into `hits`.

    Args:
        scenes: handles of the scenes.
        time: times in 0 to 1; without elements: 0.5 for all rays.
        hits: its `actor` is the number of the instance, `MISS` in a scene of triangles.
    """
    _intersect_all(scenes, origin, direction, time, hits, ctypes.addressof(_arguments))


def occluded(scenes: Scenes, origin: Rays, direction: Rays, time: Times) -> Bool[np.ndarray, "N"]:
    """Return whether each ray hits anything in the scenes. The arguments are as for `intersect`."""
    out = np.empty(len(origin), np.bool_)
    _occluded_all(scenes, origin, direction, time, out, ctypes.addressof(_arguments))
    return out
