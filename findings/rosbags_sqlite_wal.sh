#!/usr/bin/env bash
# rosbags 0.11.9: a rosbag2 file in sqlite3 is opened as immutable, so messages that a recorder has
# committed but that still are in the write-ahead log beside it (bag.db3-wal) are not there, without
# a word. rosbag2 records that way with its storage profile "resilient", and a recorder that was
# killed leaves such a file. sqlite3 itself, in the standard library, reads all of them.
# Seen: of 40 committed messages rosbags gives 10, and sqlite3 40.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'PYTHON'
import shutil
import sqlite3
from pathlib import Path

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
kind = "std_msgs/msg/Int32"
message = bytes(store.serialize_cdr(store.types[kind](7), kind))
with Writer("bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
    connection = writer.add_connection("/count", kind, typestore=store)
    for number in range(10):
        writer.write(connection, number, message)
file = next(Path("bag").glob("*.db3"))
recorder = sqlite3.connect(file)
recorder.execute("PRAGMA journal_mode=WAL")
(topic,) = recorder.execute("SELECT id FROM topics").fetchone()
for number in range(10, 40):
    recorder.execute(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", (topic, number, message)
    )
recorder.commit()
left = Path("left")  # what a kill leaves: the file and the log beside it
left.mkdir()
for name in (file.name, f"{file.name}-wal"):
    shutil.copy(file.parent / name, left / name)
recorder.close()
with Reader(left / file.name) as reader:
    read = sum(1 for _ in reader.messages(reader.connections))
with sqlite3.connect(left / file.name) as database:
    (whole,) = database.execute("SELECT COUNT(*) FROM messages").fetchone()
print("rosbags:", read, "messages; sqlite3:", whole)
assert (read, whole) == (10, 40)
PYTHON
