"""The functions of the Aravis library that a camera needs, called through ctypes.

Aravis' Python binding is PyGObject, which is built for the system's own Python and must be
compiled for any other. The C library alone is one package of 0.2 MB with two dozen calls.
"""

from __future__ import annotations

import ctypes
import sys
from typing import Any

from haselab.base import DeviceError

__all__ = ["INSTALL", "AravisLibrary"]

_NAMES = {
    "linux": ("libaravis-0.8.so.0", "libgobject-2.0.so.0", "libglib-2.0.so.0"),
    "darwin": ("libaravis-0.8.0.dylib", "libgobject-2.0.0.dylib", "libglib-2.0.0.dylib"),
    "win32": ("libaravis-0.8-0.dll", "libgobject-2.0-0.dll", "libglib-2.0-0.dll"),
}
_DO = {
    "linux": "apt-get install libaravis-0.8-0",
    "darwin": "brew install aravis",
    "win32": "conda install -c conda-forge aravis",
}
_PLATFORM = sys.platform if sys.platform in _NAMES else "linux"
INSTALL = f"Run: {_DO[_PLATFORM]}"


class _GError(ctypes.Structure):
    _fields_ = (
        ("domain", ctypes.c_uint32),
        ("code", ctypes.c_int),
        ("message", ctypes.c_char_p),
    )


_POINTER = ctypes.c_void_p
_TEXT = ctypes.c_char_p
_INT = ctypes.c_int
_INT_OUT = ctypes.POINTER(ctypes.c_int)
_DOUBLE = ctypes.c_double
_DOUBLE_OUT = ctypes.POINTER(ctypes.c_double)
_U64 = ctypes.c_uint64
_SIZE_OUT = ctypes.POINTER(ctypes.c_size_t)
_ERROR_OUT = ctypes.POINTER(ctypes.POINTER(_GError))

# name: result, arguments. Those in _FAILING take a GError after them.
_FAILING: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "camera_new": (_POINTER, (_TEXT,)),
    "camera_create_stream": (_POINTER, (_POINTER, _POINTER, _POINTER)),
    "camera_get_vendor_name": (_TEXT, (_POINTER,)),
    "camera_get_model_name": (_TEXT, (_POINTER,)),
    "camera_get_device_serial_number": (_TEXT, (_POINTER,)),
    "camera_get_sensor_size": (None, (_POINTER, _INT_OUT, _INT_OUT)),
    "camera_get_region": (None, (_POINTER, _INT_OUT, _INT_OUT, _INT_OUT, _INT_OUT)),
    "camera_set_region": (None, (_POINTER, _INT, _INT, _INT, _INT)),
    "camera_set_pixel_format_from_string": (None, (_POINTER, _TEXT)),
    "camera_get_payload": (ctypes.c_uint, (_POINTER,)),
    "camera_is_frame_rate_available": (_INT, (_POINTER,)),
    "camera_get_frame_rate_bounds": (None, (_POINTER, _DOUBLE_OUT, _DOUBLE_OUT)),
    "camera_set_frame_rate": (None, (_POINTER, _DOUBLE)),
    "camera_get_frame_rate": (_DOUBLE, (_POINTER,)),
    "camera_is_exposure_auto_available": (_INT, (_POINTER,)),
    "camera_set_exposure_time_auto": (None, (_POINTER, _INT)),
    "camera_get_exposure_time_bounds": (None, (_POINTER, _DOUBLE_OUT, _DOUBLE_OUT)),
    "camera_set_exposure_time": (None, (_POINTER, _DOUBLE)),
    "camera_get_exposure_time": (_DOUBLE, (_POINTER,)),
    "camera_is_gain_auto_available": (_INT, (_POINTER,)),
    "camera_set_gain_auto": (None, (_POINTER, _INT)),
    "camera_get_gain_bounds": (None, (_POINTER, _DOUBLE_OUT, _DOUBLE_OUT)),
    "camera_set_gain": (None, (_POINTER, _DOUBLE)),
    "camera_set_acquisition_mode": (None, (_POINTER, _INT)),
    "camera_clear_triggers": (None, (_POINTER,)),
    "camera_set_trigger": (None, (_POINTER, _TEXT)),
    "camera_get_string": (_TEXT, (_POINTER, _TEXT)),
    "camera_set_string": (None, (_POINTER, _TEXT, _TEXT)),
    "camera_get_float": (_DOUBLE, (_POINTER, _TEXT)),
    "camera_get_integer": (ctypes.c_int64, (_POINTER, _TEXT)),
    "camera_set_boolean": (None, (_POINTER, _TEXT, _INT)),
    "camera_is_feature_available": (_INT, (_POINTER, _TEXT)),
    "camera_gv_auto_packet_size": (ctypes.c_uint, (_POINTER,)),
    "camera_gv_set_packet_size": (None, (_POINTER, _INT)),
    "camera_gv_get_packet_size": (ctypes.c_uint, (_POINTER,)),
    "camera_start_acquisition": (None, (_POINTER,)),
    "camera_stop_acquisition": (None, (_POINTER,)),
}
_OTHERS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "enable_interface": (None, (_TEXT,)),
    "camera_is_gv_device": (_INT, (_POINTER,)),
    "gv_stream_get_statistics": (None, (_POINTER, *[ctypes.POINTER(_U64)] * 2)),
    "gv_stream_socket_buffer_get_type": (ctypes.c_size_t, ()),
    "buffer_new_allocate": (_POINTER, (ctypes.c_size_t,)),
    "buffer_get_status": (_INT, (_POINTER,)),
    "buffer_get_frame_id": (_U64, (_POINTER,)),
    "buffer_get_timestamp": (_U64, (_POINTER,)),
    "buffer_get_system_timestamp": (_U64, (_POINTER,)),
    "buffer_get_image_width": (_INT, (_POINTER,)),
    "buffer_get_image_height": (_INT, (_POINTER,)),
    "buffer_get_image_data": (_POINTER, (_POINTER, _SIZE_OUT)),
    "stream_push_buffer": (None, (_POINTER, _POINTER)),
    "stream_try_pop_buffer": (_POINTER, (_POINTER,)),
    "stream_get_statistics": (None, (_POINTER, *[ctypes.POINTER(_U64)] * 3)),
}


class _GValue(ctypes.Structure):
    _fields_ = (("type", ctypes.c_size_t), ("data", ctypes.c_uint64 * 2))


class AravisLibrary:
    """Loads Aravis and calls its functions: `call` for those that may fail, `get` for others.

    Raises:
        DeviceError: Aravis is not installed.
    """

    def __init__(self) -> None:
        aravis, gobject, glib = _NAMES[_PLATFORM]
        try:
            self._aravis = ctypes.CDLL(aravis)
            self._gobject = ctypes.CDLL(gobject)
            self._glib = ctypes.CDLL(glib)
        except OSError:
            raise DeviceError(
                f"A GenICam camera needs the library Aravis 0.8 ({aravis}), which is not "
                f"installed. {INSTALL}"
            ) from None
        self._functions: dict[str, Any] = {}
        for name, (answer, arguments) in _FAILING.items():
            self._declare(name, answer, (*arguments, _ERROR_OUT))
        for name, (answer, arguments) in _OTHERS.items():
            self._declare(name, answer, arguments)
        self._gobject.g_object_unref.argtypes = (_POINTER,)
        self._gobject.g_object_unref.restype = None
        self._gobject.g_value_init.argtypes = (ctypes.POINTER(_GValue), ctypes.c_size_t)
        self._gobject.g_value_init.restype = _POINTER
        self._gobject.g_value_set_enum.argtypes = (ctypes.POINTER(_GValue), _INT)
        self._gobject.g_value_set_enum.restype = None
        self._gobject.g_object_set_property.argtypes = (_POINTER, _TEXT, ctypes.POINTER(_GValue))
        self._gobject.g_object_set_property.restype = None
        self._glib.g_error_free.argtypes = (ctypes.POINTER(_GError),)
        self._glib.g_error_free.restype = None

    def _declare(self, name: str, answer: Any, arguments: tuple[Any, ...]) -> None:
        try:
            function = getattr(self._aravis, f"arv_{name}")
        except AttributeError:
            raise DeviceError(
                f"The installed Aravis has no function arv_{name}, so it is older than 0.8. "
                f"{INSTALL}"
            ) from None
        function.restype, function.argtypes = answer, arguments
        self._functions[name] = function

    def get(self, name: str, *arguments: Any) -> Any:
        """Call a function that cannot fail.

        Args:
            name: without `arv_`.
            arguments: as for the C function.
        Returns:
            Its result.
        """
        return self._functions[name](*arguments)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function that may fail.

        Args:
            name: without `arv_`.
            arguments: as for the C function, without the error.
        Returns:
            Its result.
        Raises:
            DeviceError: The function failed; the text is the library's.
        """
        error = ctypes.POINTER(_GError)()
        answer = self._functions[name](*arguments, ctypes.byref(error))
        if error:
            text = (error.contents.message or b"").decode("utf-8", "replace")
            self._glib.g_error_free(error)
            raise DeviceError(f"{text.strip().rstrip('.')} (arv_{name}).")
        return answer

    def integers(self, name: str, camera: Any, count: int) -> list[int]:
        """Call a function that returns several integers.

        Args:
            name: of a function that may fail.
            camera: its first argument.
            count: number of integers.
        Returns:
            The integers.
        """
        values = [ctypes.c_int() for _ in range(count)]
        self.call(name, camera, *values)
        return [value.value for value in values]

    def bounds(self, name: str, camera: Any) -> tuple[float, float]:
        """Get the lowest and the highest value of a setting.

        Args:
            name: of a function that may fail.
            camera: its first argument.
        Returns:
            Low and high.
        """
        low, high = ctypes.c_double(), ctypes.c_double()
        self.call(name, camera, low, high)
        return low.value, high.value

    def set_enum(self, thing: Any, name: str, type_name: str, value: int) -> None:
        """Set a property of an object to a value of an enumeration.

        Args:
            thing: the object.
            name: of the property.
            type_name: function that gives the enumeration's type, without `arv_`.
            value: a value of that enumeration.
        """
        boxed = _GValue()
        self._gobject.g_value_init(ctypes.byref(boxed), self.get(type_name))
        self._gobject.g_value_set_enum(ctypes.byref(boxed), value)
        self._gobject.g_object_set_property(thing, name.encode(), ctypes.byref(boxed))

    def release(self, thing: Any) -> None:
        """Release a camera or a stream."""
        self._gobject.g_object_unref(thing)
