"""MAVLink's microservices: connection, missions, parameters, events, files and logs."""
