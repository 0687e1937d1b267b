"""Large scenes: how they are cut into blocks, who sees which block, and fields that route points to blocks
and blend them.
"""
