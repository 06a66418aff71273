"""The occupancy network, and the descriptor field it makes of an object.

Modules:
    checkpoint: weights on disk (safetensors)
    encoding: point cloud -> field
    field: the descriptor field of one object
    foreign: points of a cloud that are not of its object
    model: parameters, sizes and origin of a network
    ndf_checkpoint: converter of published PyTorch checkpoints
    occupancy: the network: encoder, decoder, configuration
    refinement: a field's shape fitted to its points
    surface: the surface of occupancy 1/2 as triangles
    tensor_file: tensors in a file of PyTorch or safetensors, by name
    torch_pickle: the pickle in a PyTorch file, read without being executed
    vector_neurons: rotation-equivariant layers
"""
