"""The plug-in mechanism (registry, slots, codec) and the built-in plug-ins, registered as a stranger's would
be.
"""
