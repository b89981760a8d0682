"""Threads that share the tasks of launches on a CPU.

Each thread of a team makes the same launches in the same order. Of each it does the tasks that no other thread has
begun, and goes on when all tasks are done, whoever did them. So a thread that comes late finds nothing to do and is
waited for by nobody, and results do not depend on who does what, nor on the number of threads. The tasks of a launch
touch different places. Where a thread is alone, and on a GPU, it does every task.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# How often a thread looks whether the others are done before it lets them have its processor: some 10 microseconds.
PATIENCE = 256


@wp.struct
class Turn:
    """What the threads of a team know of each other in one launch."""

    counts: wp.array2d(dtype=wp.int32)  # [launch_count, 2] how many tasks of a launch were begun, how many were done
    launch: wp.int32  # which launch it is
    tasks: wp.int32  # how many tasks it has; 0 where a thread is alone
    give_way: wp.uint64  # address of a function that lets other threads have the processor


@wp.func_native("""
    if (turn.tasks == 0) return true;
    #ifndef __CUDACC__
    int* begun = turn.counts.data + 2 * turn.launch;
    int next = task;
    return __atomic_load_n(begun, __ATOMIC_RELAXED) == task
        && __atomic_compare_exchange_n(begun, &next, task + 1, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED);
    #endif
    return false;
""")
def take(turn: Turn, task: int) -> bool:
    """Say whether it is for this thread to do a task; to be asked for tasks 0, 1, 2 ..."""
    ...


@wp.func_native(f"""
    if (turn.tasks == 0) return;
    #ifndef __CUDACC__
    int* done = turn.counts.data + 2 * turn.launch + 1;
    if (mine) __atomic_fetch_add(done, 1, __ATOMIC_RELEASE);
    if (task < turn.tasks - 1) return;
    using function = auto (*)() -> int;
    for (int looked = 0; __atomic_load_n(done, __ATOMIC_ACQUIRE) < turn.tasks; looked += looked < {PATIENCE}) {{
        if (looked == {PATIENCE}) ((function)turn.give_way)();
        #if defined(__x86_64__)
        else __builtin_ia32_pause();
        #elif defined(__aarch64__)
        else __builtin_arm_yield();
        #endif
    }}
    #endif
""")
def leave(turn: Turn, task: int, mine: bool):
    """Note that a task is done if it was for this thread; after the last task, wait until all are."""
    ...


@wp.kernel
def volunteer(
    # Threads:
    turn: Turn,
    # Out:
    chosen: wp.array(dtype=wp.int32),
):
    """Overwrite chosen[0]: 1 for the thread that is to do what only one of them may do, 0 for the others."""
    chosen[wp.tid()] = wp.int32(take(turn, 0))


@wp.kernel
def rejoin(
    # Threads:
    turn: Turn,
    # In:
    chosen: wp.array(dtype=wp.int32),
):
    """Wait until the thread that was chosen has done it."""
    leave(turn, 0, chosen[wp.tid()] == 1)
