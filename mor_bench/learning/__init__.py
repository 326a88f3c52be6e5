"""Training of networks, and fast inference.

Here: the training loop with its checkpoints, a multilayer perceptron, back ends for single queries,
and the ONNX graph of a network. Not here: methods, and code that uses a mesh.

This package imports torch. Only methods that train a network import it, so all others run without
torch. Start with `training.train`. `training_plan` holds its input, `training_loop` the steps, and
`checkpoint` the file from which a stopped training resumes. `inference` computes predictions.
"""
