"""Files on the autopilot: services over MAVLink FTP."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from mavros_msgs.msg import FileEntry
from mavros_msgs.srv import (
    FileChecksum,
    FileClose,
    FileList,
    FileMakeDir,
    FileOpen,
    FileRead,
    FileRemove,
    FileRemoveDir,
    FileRename,
    FileTruncate,
    FileWrite,
)
from std_srvs.srv import Empty, EmptyResponse

from xtdrone_mavros.link.ftp_client import FtpClient, FtpError
from xtdrone_mavros.uas import Plugin, Uas


class FtpPlugin(Plugin):
    """MAVROS's ftp. A failed request returns ``success`` false and an errno in ``r_errno``."""

    name = "ftp"

    def __init__(self, uas: Uas) -> None:
        """Offer the services."""
        super().__init__(uas)
        self._client = FtpClient(uas.link.send, uas.target, uas.link.source[0], uas.ros.needs_time)
        self.replies = {"FILE_TRANSFER_PROTOCOL": self._client.on_answer}
        self._offer("list", FileList, self._list)
        self._offer("open", FileOpen, lambda r: {"size": self._client.open(r.file_path, r.mode)})
        self._offer("close", FileClose, lambda r: self._client.close(r.file_path))
        self._offer("read", FileRead, lambda r: {"data": self._client.read(r.file_path, r.offset, r.size)})
        self._offer("write", FileWrite, lambda r: self._client.write(r.file_path, r.offset, bytes(r.data)))
        self._offer("remove", FileRemove, lambda r: self._client.remove(r.file_path))
        self._offer("rename", FileRename, lambda r: self._client.rename(r.old_path, r.new_path))
        self._offer("truncate", FileTruncate, lambda r: self._client.truncate(r.file_path, r.length))
        self._offer("mkdir", FileMakeDir, lambda r: self._client.make_folder(r.dir_path))
        self._offer("rmdir", FileRemoveDir, lambda r: self._client.remove_folder(r.dir_path))
        self._offer("checksum", FileChecksum, lambda r: {"crc32": self._client.checksum(r.file_path)})
        uas.service("ftp/reset", Empty, self._reset)

    def connected(self, connected: bool) -> None:
        """Close the sessions of another autopilot, or of this one before a reboot."""
        if connected:
            self._client.forget()

    def _offer(self, name: str, kind: Any, act: Callable[[Any], dict[str, Any] | None]) -> None:
        def answer(request: Any) -> Any:
            try:
                return kind._response_class(success=True, r_errno=0, **(act(request) or {}))
            except FtpError as error:
                self.uas.warn(f"ftp {name}", "ftp/%s failed: %s", name, os.strerror(error.number))
                return kind._response_class(success=False, r_errno=error.number)

        self.uas.service(f"ftp/{name}", kind, answer)

    def _list(self, request: Any) -> dict[str, Any]:
        kinds = {True: FileEntry.TYPE_DIRECTORY, False: FileEntry.TYPE_FILE}
        found = self._client.list(request.dir_path)
        return {"list": [FileEntry(entry.name, kinds[entry.is_folder], entry.size) for entry in found]}

    def _reset(self, _request: Any) -> EmptyResponse:
        try:
            self._client.reset()
        except FtpError as error:
            self.uas.warn("ftp reset", "ftp/reset failed: %s", os.strerror(error.number))
        return EmptyResponse()
