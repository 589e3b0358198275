"""Threads have names in the system's list, by which their CPU time is told apart."""

import os
from concurrent.futures import ThreadPoolExecutor

from fog_runtime.machine.task_usage import name_thread, sample


def test_named_thread_is_listed_by_its_name_among_the_threads_of_its_process():
    before = {thread.name for thread in sample(os.getpid()).values()}
    with ThreadPoolExecutor(1, initializer=name_thread, initargs=("decide-7",)) as pool:
        names = pool.submit(lambda: [thread.name for thread in sample(os.getpid()).values()]).result()
    assert "decide-7" not in before
    assert names.count("decide-7") == 1


def test_thread_keeps_its_name_where_the_list_can_not_be_written(tmp_path):
    name_thread("decide", tmp_path)
