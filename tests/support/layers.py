"""The layers of the package, from the lowest to the highest."""

# A layer may import itself and every layer of a line above; layers of one line do not import each other.
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
    {"capture", "pipeline"},
    {"train"},
    {"eval"},
    {"cli"},
]
