"""Machine code by LLVM: emit its `lines`, write graphs as functions of a `module`, and compile (`compilation`)."""
