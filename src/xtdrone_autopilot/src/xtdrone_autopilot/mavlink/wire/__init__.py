"""Wire format of MAVLink messages: dialect, decoding, packing."""
