"""A live view of a scene: the part without a window (`session`), a window of VTK, and a server for browsers."""
