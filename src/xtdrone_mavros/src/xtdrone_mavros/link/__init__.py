"""The MAVLink side of one vehicle: datagrams, acknowledgements, requests, plans and files."""
