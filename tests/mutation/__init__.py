"""Plant faults in a copy of the tree and see whether the tests notice them.

    python -m tests.mutation                        every fault
    python -m tests.mutation storage console        the faults of some areas
    python -m tests.mutation support_counts_itself  one fault
    python -m tests.mutation --list                 names only

A fault is a text of one file, its replacement, and the tests that should notice it (see `faults`).
For each one the text is replaced in a temporary copy of the tree and the tests run there: a test
that fails means *caught*, none means *survived*. The same tests run once without any fault first, so
that a test which fails anyway proves nothing. A text that no longer occurs exactly once in its file
is an error: the code has moved on and the fault must follow. The exit status is 0 when every fault is
caught, 1 when one survives, 2 when one cannot be planted or judged.

Not part of CI: all faults take about half an hour. Kernels that numba has compiled beside the sources
are copied with their time stamps; do not plant faults in a file of kernels, since kernels in other
files would go on using the machine code that was compiled before.
"""
