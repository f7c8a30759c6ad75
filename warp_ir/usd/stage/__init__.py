"""Opening a stage: sizes that a damaged file may claim are checked first, and .mtlx files become layers."""
