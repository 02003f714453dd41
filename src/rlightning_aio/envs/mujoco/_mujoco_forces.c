/* One function, which MuJoCo's threads call for each simulation; see `mujoco_forces`.
 *
 * It needs neither Python nor MuJoCo's headers: MuJoCo's functions are given as pointers, and the
 * places of its fields as offsets.
 */

#ifndef Py_GIL_DISABLED
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <stdint.h>
#include <string.h>

typedef void (*Compute)(const void *model, void *data);

/* The same as `_Output` and `_Plan` in mujoco_forces.py. */
typedef struct {
    int64_t offset; /* Of the field's pointer in mjData. */
    char *values;   /* Of all simulations. */
    int64_t size;   /* Bytes of one simulation. */
} Output;

typedef struct {
    Compute step;
    Compute finish;
    int64_t num_steps;
    int64_t num_outputs;
    Output outputs[];
} Plan;

/* An mjfBatchFunc. */
static void
step_and_finish(const void *model, void *data, int simulation, void *argument)
{
    const Plan *plan = argument;
    for (int64_t step = 0; step < plan->num_steps; step++) {
        plan->step(model, data);
    }
    plan->finish(model, data);
    for (int64_t k = 0; k < plan->num_outputs; k++) {
        const Output *output = &plan->outputs[k];
        const char *values;
        memcpy(&values, (const char *)data + output->offset, sizeof values);
        memcpy(output->values + simulation * output->size, values, (size_t)output->size);
    }
}

static int
add_address(PyObject *module)
{
    PyObject *address = PyLong_FromVoidPtr((void *)(uintptr_t)step_and_finish);
    int failed = PyModule_AddObjectRef(module, "STEP_AND_FINISH", address);
    Py_XDECREF(address);
    return failed;
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, add_address},
#ifdef Py_mod_gil
    {Py_mod_gil, Py_MOD_GIL_NOT_USED},
#endif
    {0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "rlightning_aio.envs.mujoco._mujoco_forces",
    .m_doc = "STEP_AND_FINISH: the address of a function for `mjb_apply`.",
    .m_slots = slots,
};

PyMODINIT_FUNC
PyInit__mujoco_forces(void)
{
    return PyModuleDef_Init(&module);
}
