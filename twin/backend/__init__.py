"""LLVM library and array types of the renderer."""
