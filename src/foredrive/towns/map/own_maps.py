"""Road maps of one's own: OpenDRIVE files, completed so that py123d reads all of their roads.

py123d 0.7.0 asks for elements that OpenDRIVE leaves out where they say nothing, and drops roads without them:
roads that are linked at one end or none, and limits in the standard's own words. Here they are written down.
It also removes lanes that begin or end beside another one, as all but one do at an open end.
"""

import contextlib
import gzip
import io
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Set
from pathlib import Path

import numpy as np
from py123d.parser.opendrive.utils import collection

from foredrive.errors import InputError

OPEN_END = {"elementType": "junction", "elementId": "-1"}
"""The link of a road's end where it is linked to nothing: to a junction that does not exist."""
KMH = {"m/s": 3.6, "mph": 1.609344, "km/h": 1.0, None: 3.6}
"""Kilometres an hour in a unit of speed; without one OpenDRIVE means m/s."""
READ = ("line", "arc", "spiral", "paramPoly3")
"""Shapes of reference lines that are read."""
STRAIGHT = 1e-9
"""Curvature below which an arc is a line, 1/m."""
EVEN = 2e-10
"""Change of curvature below which a spiral is an arc, 1/m²."""
DROPPED = "Error parsing road element"
"""Begins the line that py123d prints of a road that it leaves out."""
PIECE_M = 1.0
"""Length of the arcs that stand for a polynomial, m."""


def _completed_root(path: Path) -> ElementTree.Element:
    """Return an OpenDRIVE file (`.xodr` or `.xodr.gz`), with what it leaves out written down.

    Raises:
        InputError: it is no OpenDRIVE file, or has roads that are not read.
    """
    root = _root(path)
    if root.tag != "OpenDRIVE" or root.find("road") is None:
        raise InputError(f"{path}: no OpenDRIVE file with roads")
    header = _child(root, "header")
    header.attrib = {**dict.fromkeys(("north", "south", "east", "west"), "0"), **header.attrib}
    roads = {road.get("id", "") for road in root.iter("road")}
    for road in root.iter("road"):
        _check(path, road)
        _complete(road, roads)
    for connection in root.iter("connection"):
        if not {connection.get("incomingRoad"), connection.get("connectingRoad")} <= roads:
            raise InputError(f"{path}: a junction connects roads that are not in the file, or directly")
    for controller in root.iter("controller"):
        controller.set("sequence", controller.get("sequence", "0"))
    return root


@contextlib.contextmanager
def completed(path: Path) -> Iterator[Path]:
    """Yield a file with the same map in which nothing is left out. py123d removes no lane while it is read.

    Raises:
        InputError: it is no OpenDRIVE file, or has roads that are not read.
    """
    root = _completed_root(path)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / f"{path.name.split('.')[0]}.xodr"
        ElementTree.ElementTree(root).write(whole)
        # py123d looks the function up while it reads
        removing = collection._correct_lanes_with_no_connections
        collection._correct_lanes_with_no_connections = lambda lanes: None
        try:
            yield whole
        finally:
            collection._correct_lanes_with_no_connections = removing


@contextlib.contextmanager
def reading_own(path: Path) -> Iterator[None]:
    """Turn the errors of py123d over a file of one's own, printed ones too, into an `InputError`."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            yield
    except InputError:
        raise
    except (LookupError, ValueError, TypeError, AssertionError, AttributeError, NotImplementedError) as error:
        raise InputError(f"{path}: not read by py123d: {type(error).__name__}: {error}") from error
    dropped = [line for line in printed.getvalue().splitlines() if line.startswith(DROPPED)]
    if dropped:
        raise InputError(f"{path}: not read by py123d: {dropped[0]}")


def left_out(path: Path) -> str:
    """Return what of a file is not read, in words; empty if it is all read.

    Raises:
        InputError: it is no OpenDRIVE file, or has roads that are not read.
    """
    written = _root(path)
    tilted = sum(
        any(float(tilt.get(key, "0")) for tilt in road.iter("superelevation") for key in "abcd")
        for road in written.iter("road")
    )
    outside = (road for road in written.iter("road") if road.get("junction", "-1") == "-1")
    signals = sum(len(road.findall("signals/signal")) for road in outside)
    things = sum(thing.get("type") != "crosswalk" for thing in written.iter("object"))
    counts = ((tilted, "tilts of roads"), (signals, "signals outside of junctions"), (things, "objects"))
    return ", ".join(f"{count} {what}" for count, what in counts if count)


def _root(path: Path) -> ElementTree.Element:
    try:
        text = path.read_bytes()
        return ElementTree.fromstring(gzip.decompress(text) if path.suffix == ".gz" else text)
    except (OSError, EOFError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: {error}") from error


def _check(path: Path, road: ElementTree.Element) -> None:
    name = road.get("id", "")
    if road.get("rule", "RHT") != "RHT":
        raise InputError(f"{path}: road {name} has traffic on the left, which towns have not")
    if not name.lstrip("-").isdigit():
        raise InputError(f"{path}: the id of road {name!r} is no number")
    if any(
        lane.find("width") is None for side in ("left", "right") for lane in road.iterfind(f".//{side}/lane")
    ):
        raise InputError(f"{path}: road {name} has a lane without width; borders are not read")
    shapes = {shape.tag for geometry in road.iterfind("planView/geometry") for shape in geometry}
    if other := shapes - {*READ, "userData"}:
        raise InputError(f"{path}: road {name} is a {min(other)}; {', '.join(READ)} are read")


def _complete(road: ElementTree.Element, roads: Set[str]) -> None:
    link = _child(road, "link")
    for name in ("predecessor", "successor"):
        end = _child(link, name)
        if end.get("elementType") != "junction" and end.get("elementId") not in roads:
            end.attrib = dict(OPEN_END)
    for plan in road.iterfind("planView"):
        shapes = [piece for geometry in plan for piece in _as_read(geometry)]
        plan[:] = shapes
    # Of objects, crossings that have a shape are read; others may lack what those have
    for objects in road.iterfind("objects"):
        for thing in list(objects):
            has_shape = thing.find("outline/cornerLocal") is not None or {"length", "width"} <= set(
                thing.attrib
            )
            if thing.get("type") != "crosswalk" or not has_shape:
                objects.remove(thing)
        for crossing in objects:
            crossing.attrib = {**dict.fromkeys(("zOffset", "pitch", "roll", "hdg"), "0"), **crossing.attrib}
    # Polynomials that are 0 everywhere
    _polynomial(_child(road, "elevationProfile"), "elevation")
    lanes = _child(road, "lanes")
    if lanes.find("laneOffset") is None:
        zero = ElementTree.Element("laneOffset", {"s": "0", **dict.fromkeys("abcd", "0")})
        lanes.insert(0, zero)
    for kind in road.iterfind("type"):
        speed = kind.find("speed")
        if speed is None:
            continue
        limit, unit = speed.get("max", ""), speed.get("unit")
        try:
            speed.attrib.update(max=repr(float(limit) * KMH[unit]), unit="km/h")
        except (ValueError, KeyError):
            kind.remove(speed)  # "no limit" and "undefined"


def _as_read(geometry: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the shapes that stand for one of a reference line, of which py123d reads all."""
    (shape,) = (shape for shape in geometry if shape.tag in READ)
    if shape.tag == "paramPoly3":
        return _arcs_of(geometry, shape)
    # py123d refuses a spiral without change of curvature, and an arc without curvature
    if shape.tag == "spiral":
        begin, end = (float(shape.get(key, "nan")) for key in ("curvStart", "curvEnd"))
        if abs(end - begin) < EVEN * float(geometry.get("length", "nan")):
            shape.tag, shape.attrib = "arc", {"curvature": repr(0.5 * (begin + end))}
    if shape.tag == "arc" and abs(float(shape.get("curvature", "nan"))) < STRAIGHT:
        shape.tag = "line"
    return [geometry]


def _arcs_of(geometry: ElementTree.Element, shape: ElementTree.Element) -> list[ElementTree.Element]:
    """Return arcs of a metre that follow a cubic of a parameter; s is the length along it."""
    s0, x0, y0, yaw0, length = (float(geometry.get(key, "nan")) for key in ("s", "x", "y", "hdg", "length"))
    u, v = (np.array([float(shape.get(key + axis, "nan")) for key in "dcba"]) for axis in "UV")
    p = np.linspace(0.0, 1.0 if shape.get("pRange") == "normalized" else length, 20 * int(length + 1) + 1)
    du, dv = np.polyval(np.polyder(u), p), np.polyval(np.polyder(v), p)
    # Length along the cubic at each parameter, in the unit of s
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(np.polyval(u, p)), np.diff(np.polyval(v, p))))])
    along *= length / along[-1]
    ends = np.linspace(0.0, length, int(np.ceil(length / PIECE_M)) + 1)
    p_end = np.interp(ends, along, p)
    yaw = np.interp(ends, along, np.unwrap(np.arctan2(dv, du)))
    # From the cubic's frame to the map's
    x, y = np.polyval(u, p_end), np.polyval(v, p_end)
    x, y = x0 + np.cos(yaw0) * x - np.sin(yaw0) * y, y0 + np.sin(yaw0) * x + np.cos(yaw0) * y
    pieces = []
    for k, piece_m in enumerate(np.diff(ends).tolist()):
        values = {"s": s0 + ends[k], "x": x[k], "y": y[k], "hdg": yaw0 + yaw[k], "length": piece_m}
        piece = ElementTree.Element("geometry", {key: repr(float(value)) for key, value in values.items()})
        curvature = float(yaw[k + 1] - yaw[k]) / piece_m
        arc = {} if abs(curvature) < STRAIGHT else {"curvature": repr(curvature)}
        ElementTree.SubElement(piece, "arc" if arc else "line", arc)
        pieces.append(piece)
    return pieces


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    child = element.find(tag)
    return ElementTree.SubElement(element, tag) if child is None else child


def _polynomial(element: ElementTree.Element, tag: str) -> None:
    if element.find(tag) is None:
        ElementTree.SubElement(element, tag, {"s": "0", **dict.fromkeys("abcd", "0")})
