// The page of a list that needs nothing of its own.
import { list } from "./lists.js";
import { schemas } from "./page.js";

list(Object.keys(schemas)[0]);
