"""One run at a time writes into the folder of an evaluation."""

import pytest
from filelock import FileLock, Timeout

from runners.evaluation.experiment import writing_alone


def test_a_second_run_in_a_folder_waits_for_the_first(tmp_path):
    lock, said = FileLock(tmp_path / ".lock"), list[str]()
    lock.acquire()

    def end_the_first(line):
        said.append(line)
        lock.release()

    with writing_alone(tmp_path, end_the_first):
        assert said == [f"another run is at work in {tmp_path}; this one waits until it ends"]
        with pytest.raises(Timeout):
            lock.acquire(timeout=0)
