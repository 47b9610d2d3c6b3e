"""The paper's perception models in plain PyTorch, in published and in tiny sizes."""
