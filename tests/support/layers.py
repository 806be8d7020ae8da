"""The rooms of the package, from the lowest to the highest."""

# A room may import itself and every room of a line above; rooms of one line know nothing of each other.
LAYERS = [
    {"errors"},
    {"kernels"},
    {"_bridge"},
    {"geometry"},
    {"render"},
    {"io", "fit"},
    {"views", "synthetic", "nn"},
    {"prepare"},
    {"output"},
    {"pipeline"},
    {"train"},
    {"eval"},
    {"cli"},
]
