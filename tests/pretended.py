"""A second device for machines without one: the CPU's tensors in disguise.

Tensors on the device "pretended" hold one of the CPU each. They cannot be made NumPy arrays, and operations on them
refuse tensors of the CPU where CUDA does, so that what passes here leaves out no `.to(device)`. Times mean nothing.
"""

import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

COPIES = {"aten::_to_copy", "aten::copy_"}
PICKS = {"aten::index", "aten::index_put_", "aten::_index_put_impl_"}
"""Operations on a tensor of the device, for which indices may be on the CPU."""


class Pretended(torch.Tensor):
    """A tensor on the device, which holds one of the CPU."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held):
        """A tensor of the shape and type of the one held."""
        where = {}
        if held.layout == torch.strided:  # sparse tensors have none
            where = {"strides": held.stride(), "storage_offset": held.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.shape, dtype=held.dtype, device="pretended", **where
        )
        made.held = held
        return made

    def tolist(self):
        """As numbers, for which a device is waited for, but nothing is moved by hand."""
        return self.held.tolist()

    def __repr__(self):
        """As that of the tensor held."""
        return f"Pretended({self.held})"

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        """Compute on the CPU."""
        return _computed(function, args, kwargs or {})


def _computed(function, args, kwargs):
    """What the function gives of the tensors held, on the device if these, or `device`, are there."""
    name = function.overloadpacket._qualified_op_name
    given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    here = [x for x in given if not isinstance(x, Pretended)]
    there = len(here) < len(given)
    apart = there and name not in COPIES and any(x.ndim for x in here)
    if apart and not (name in PICKS and isinstance(given[0], Pretended)):
        raise RuntimeError(
            f"{name}: expected all tensors on one device, {len(here)} are on the CPU"
        )
    if name == "aten::_conj":  # lazy conjugates are lost on the way
        function = torch.ops.aten._conj_physical.default
    args, kwargs = tree_map(held, args), dict(tree_map(held, kwargs))
    if kwargs.get("device") is not None:
        there = torch.device(kwargs["device"]).type == "pretended"
        kwargs["device"] = "cpu"
    result = function(*args, **kwargs)
    if not there or name == "aten::_local_scalar_dense":
        return result
    same = {id(held(x)): x for x in given}  # of operations in place

    def disguised(x):
        return same.get(id(x), Pretended(x)) if isinstance(x, torch.Tensor) else x

    return tree_map(disguised, result)


def held(x):
    """The tensor of the CPU that a tensor of the device holds; all else as it is."""
    return x.held if isinstance(x, Pretended) else x


class PretendedDevice(TorchDispatchMode):
    """While entered, tensors can be made on the device and moved there."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """As for tensors of the device, which some functions that make tensors do not have."""
        return _computed(function, args, kwargs or {})


class _Module:
    """What torch asks of a device."""

    is_initialized = is_available = staticmethod(lambda: True)
    device_count = staticmethod(lambda: 1)
    current_device = staticmethod(lambda: 0)
    _is_in_bad_fork = staticmethod(lambda: False)
    manual_seed_all = staticmethod(lambda seed: None)
    get_rng_state = staticmethod(lambda device=0: torch.get_rng_state())
    set_rng_state = staticmethod(lambda state, device=0: None)
    get_amp_supported_dtype = staticmethod(lambda: [torch.float16, torch.bfloat16])


def _copied(source, target, non_blocking=False):
    held(target).copy_(held(source))
    return target


def _empty(size, *, dtype=None, **others):
    return Pretended(torch.empty(size, dtype=dtype, device="cpu"))


def _empty_strided(size, stride, *, dtype=None, **others):
    return Pretended(torch.empty_strided(size, stride, dtype=dtype, device="cpu"))


def registered():
    """Tell torch of the device, once; return whether this version of torch can have one of Python's."""
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        return False
    backend_registration._setup_privateuseone_for_python_backend("pretended", _Module())
    library = torch.library.Library("aten", "IMPL")
    library.impl("empty.memory_format", _empty, "PrivateUse1")
    library.impl("empty_strided", _empty_strided, "PrivateUse1")
    library.impl("_copy_from", _copied, "PrivateUse1")
    _kept.append(library)
    return True


_kept = []
