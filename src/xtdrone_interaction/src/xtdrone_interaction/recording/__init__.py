"""What a recorded flight holds: bags, flight logs, archives and tables read into one :class:`.model.Recording`."""
