"""The functions of Aravis 0.8 that are used, with their C types."""

import ctypes
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint16, c_uint64, c_void_p

BUFFER_COMPLETE = 0

_DOUBLES = [POINTER(c_double)] * 2
_INTEGERS = [POINTER(c_int)] * 4
# Result and arguments; a last argument for the error is added to all of them.
_OF_CAMERA = {
    "new": (c_void_p, [c_char_p]),
    "get_sensor_size": (None, [c_void_p, *_INTEGERS[:2]]),
    "get_vendor_name": (c_char_p, [c_void_p]),
    "get_model_name": (c_char_p, [c_void_p]),
    "get_device_serial_number": (c_char_p, [c_void_p]),
    "set_acquisition_mode": (None, [c_void_p, c_int]),
    "clear_triggers": (None, [c_void_p]),
    "set_trigger": (None, [c_void_p, c_char_p]),
    "software_trigger": (None, [c_void_p]),
    "set_region": (None, [c_void_p, c_int, c_int, c_int, c_int]),
    "get_region": (None, [c_void_p, *_INTEGERS]),
    "is_feature_available": (c_int, [c_void_p, c_char_p]),
    "is_exposure_auto_available": (c_int, [c_void_p]),
    "is_gain_auto_available": (c_int, [c_void_p]),
    "set_exposure_time_auto": (None, [c_void_p, c_int]),
    "set_gain_auto": (None, [c_void_p, c_int]),
    "dup_available_pixel_formats_as_strings": (POINTER(c_char_p), [c_void_p, POINTER(c_uint)]),
    "get_pixel_format_as_string": (c_char_p, [c_void_p]),
    "set_pixel_format_from_string": (None, [c_void_p, c_char_p]),
    "create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "get_payload": (c_uint, [c_void_p]),
    "start_acquisition": (None, [c_void_p]),
    "stop_acquisition": (None, [c_void_p]),
}
for _feature in ("exposure_time", "gain", "frame_rate"):
    _OF_CAMERA |= {
        f"is_{_feature}_available": (c_int, [c_void_p]),
        f"get_{_feature}_bounds": (None, [c_void_p, *_DOUBLES]),
        f"get_{_feature}": (c_double, [c_void_p]),
        f"set_{_feature}": (None, [c_void_p, c_double]),
    }
_OTHERS = {
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (c_uint, []),
    "arv_get_device_id": (c_char_p, [c_uint]),
    "arv_get_device_serial_nbr": (c_char_p, [c_uint]),
    "arv_get_device_address": (c_char_p, [c_uint]),
    "arv_get_device_protocol": (c_char_p, [c_uint]),
    "arv_camera_is_gv_device": (c_int, [c_void_p]),
    "arv_camera_get_device": (c_void_p, [c_void_p]),
    "arv_gv_device_is_controller": (c_int, [c_void_p]),
    "arv_gv_stream_get_port": (c_uint16, [c_void_p]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
    "arv_buffer_new": (c_void_p, [c_size_t, c_void_p]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
    "arv_buffer_get_frame_id": (c_uint64, [c_void_p]),
    "arv_buffer_get_timestamp": (c_uint64, [c_void_p]),
    "arv_buffer_get_image_width": (c_int, [c_void_p]),
    "arv_buffer_get_image_height": (c_int, [c_void_p]),
    "g_object_unref": (None, [c_void_p]),
    "g_free": (None, [c_void_p]),
}


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


class AravisFunctions:
    """The library's functions as attributes, ready to be called."""

    def __init__(self, library: ctypes.CDLL):
        table = dict(_OTHERS)
        for name, (result, arguments) in _OF_CAMERA.items():
            table[f"arv_camera_{name}"] = (result, [*arguments, POINTER(POINTER(_GError))])
        for name, (result, arguments) in table.items():
            function = library[name]
            function.restype, function.argtypes = result, arguments
            setattr(self, name, function)
        self._free_error = library["g_error_free"]
        self._free_error.restype, self._free_error.argtypes = None, [c_void_p]

    def checked(self, name: str, *arguments: object) -> tuple[object, str | None]:
        """Call a function of a camera; its result, and its complaint if it has one."""
        error = POINTER(_GError)()
        result = getattr(self, name)(*arguments, byref(error))
        if not error:
            return result, None
        message = self.text(error.contents.message)
        self._free_error(error)
        return result, message

    @staticmethod
    def text(value: bytes | None) -> str:
        """A C string as text; empty if there is none."""
        return "" if value is None else value.decode(errors="replace")
