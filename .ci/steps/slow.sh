# tests marked slow: chains of commands, campaigns of faults, full matrices, cluster engines
source .ci/tools/step.sh
need environment environment core "$PYTHON" '.[test,lint]'
need MPI system mpiexec openmpi-bin
PATH="$CI_ENVIRONMENTS/core/bin:$PATH"
need mpi4py flock "$CI_ENVIRONMENTS/core.lock" pip install --quiet mpi4py
export DEEPACCIDENT_REQUIRE_MPI=1
check tests pytest -q -n auto -m slow -p no:cacheprovider --ignore tests/browser
